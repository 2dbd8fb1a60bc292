"""Where the drawing goes: a file, the desktop viewer, or a browser."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import rerun
    import rerun.blueprint as rrb

INSTALL = "pip install 'rerun-sdk>=0.39,<0.40'"


def new_recording(name: str) -> rerun.RecordingStream:
    """An empty recording of a name.

    Raises
    ------
    InputError
        When Rerun is not installed.
    """
    recording: rerun.RecordingStream = _rerun().RecordingStream("drocap", recording_id=name)
    recording.set_log_tick_enabled(False)
    recording.set_log_time_enabled(False)
    return recording


def has_screen() -> bool:
    """Whether a window can be opened here."""
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def to_file(recording: rerun.RecordingStream, path: Path, layout: rrb.Blueprint) -> None:
    """Write the recording to a file from now on."""
    recording.save(path, default_blueprint=layout)


def to_window(recording: rerun.RecordingStream, layout: rrb.Blueprint, memory_limit: str) -> None:
    """Send the recording to the desktop viewer, which is started if it does not run yet.

    Raises
    ------
    InputError
        When the viewer does not start.
    """
    try:
        recording.spawn(memory_limit=memory_limit, default_blueprint=layout)
    except RuntimeError as error:
        raise InputError(f"expected the Rerun viewer to start, it did not ({error}); use --web or --save") from None


def to_browser(
    recording: rerun.RecordingStream, layout: rrb.Blueprint, port: int, memory_limit: str, *, newest_first: bool
) -> str:
    """Serve the recording and a web viewer on two ports, ``port`` and the next; returns the page's address.

    ``newest_first``: a page that is opened late begins with what is new.

    Raises
    ------
    InputError
        When a port is taken.
    """
    try:
        source = recording.serve_grpc(
            grpc_port=port + 1, default_blueprint=layout, server_memory_limit=memory_limit, newest_first=newest_first
        )
        _rerun().serve_web_viewer(web_port=port, open_browser=has_screen(), connect_to=source)
    except (RuntimeError, OSError) as error:
        raise InputError(f"--port: expected {port} and {port + 1} to be free, found {error}; choose another") from None
    return f"http://127.0.0.1:{port}/?url={_quoted(source)}"


def _quoted(text: str) -> str:
    from urllib.parse import quote

    return quote(text, safe="")


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise InputError(f"expected the Rerun viewer, found none ({error}); run `{INSTALL}`") from None
    return rerun
