"""Outputs of a Rerun recording: a file, the desktop viewer, or a browser."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING
from urllib.parse import quote

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import rerun
    import rerun.blueprint as rrb

#: Start of the web server at most, s; a judgement.
_START_S = 20.0
INSTALL = "pip install 'rerun-sdk>=0.39,<0.40'"


def new_recording(name: str) -> rerun.RecordingStream:
    """An empty named recording."""
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
    """Send the recording to the desktop viewer, started if necessary."""
    try:
        recording.spawn(memory_limit=memory_limit, default_blueprint=layout)
    except RuntimeError as error:
        raise InputError(f"expected the Rerun viewer to start, it did not ({error}); use --web or --save") from None


@contextlib.contextmanager
def to_browser(
    recording: rerun.RecordingStream,
    layout: rrb.Blueprint,
    host: str,
    port: int,
    memory_limit: str,
) -> Iterator[str]:
    """Serve the recording and a web viewer on two ports, ``port`` and the next, while the context lasts.

    Gives the page's address.  The server is Rerun's program, not its library: the library serves the images of a
    person to the whole network.

    host : address to serve on; 127.0.0.1 = this machine alone
    """
    _check_free(host, port, port + 1)
    command = [_program(), "--serve-web", "--bind", host, "--port", str(port + 1)]
    command += ["--web-viewer-port", str(port), "--server-memory-limit", memory_limit]
    server = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for this process
        preexec_fn=_end_with_parent(),
    )
    try:
        local = "127.0.0.1" if host == "0.0.0.0" else host
        for number in (port, port + 1):
            _wait_for(server, local, number)
        source = f"rerun+http://{local}:{port + 1}/proxy"
        recording.connect_grpc(source, default_blueprint=layout)
        yield f"http://{local}:{port}/?url={quote(source, safe='')}"
    finally:
        recording.disconnect()
        server.terminate()
        server.wait()


def _program() -> str:
    import rerun_cli

    return str(Path(rerun_cli.__file__).with_name("rerun"))


def _end_with_parent() -> Callable[[], object] | None:
    """First call of the child: it ends with a killed parent (PR_SET_PDEATHSIG) and frees the ports."""
    if sys.platform != "linux":
        return None
    # Looked up here: between fork and exec the child must only call.
    return functools.partial(ctypes.CDLL(None).prctl, 1, int(signal.SIGTERM))


def _check_free(host: str, *ports: int) -> None:
    for port in ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, port))
            except OSError as error:
                raise InputError(
                    f"--host, --port: expected to serve on {host}:{port}, cannot ({error.strerror}); choose another"
                ) from None


def _wait_for(server: subprocess.Popen[bytes], host: str, port: int) -> None:
    end = time.monotonic() + _START_S
    while server.poll() is None and time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise InputError(f"--host, --port: expected Rerun's server on {host}:{port}, it did not start; choose another port")


def _rerun() -> ModuleType:
    try:
        import rerun
    except ImportError as error:
        raise InputError(f"expected the Rerun viewer, found none ({error}); run `{INSTALL}`") from None
    return rerun
