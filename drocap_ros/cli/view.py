"""``drocap view``: a motion, or that of a recorded session, in the Rerun viewer."""

from __future__ import annotations

import argparse
import contextlib
import re
import webbrowser
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.atomic_output import output_file
from drocap_ros.cli.options import Subparsers, add_command, read_motion
from drocap_ros.cli.running import interruptible, progress_bars
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import rerun

    from drocap_ros.clip import Progress
    from drocap_ros.motion import Motion

#: Of the web page; the next one carries the data.
PORT = 9090


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "view",
        run,
        help="a motion, or that of a recorded session, in 3D",
        description="Show a motion in the Rerun viewer: body, camera and picture over the time of the images, errors. "
        "Of a session: the poses that the live graph found, computed again. In a window, or in a browser where there "
        "is no screen or with --web.",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        type=Path,
        help="motion.npz or the folder that holds it; session folder, .mcap, .bag or rosbag2 folder",
    )
    parser.add_argument("--save", metavar="FILE", type=Path, help="write an .rrd file instead of opening a viewer")
    parser.add_argument("--web", action="store_true", help="serve a page for a browser, also when there is a screen")
    parser.add_argument("--port", type=int, default=PORT, help=f"of --web, with the next one (default {PORT})")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address of --web; 0.0.0.0 shows it to the whole network (default 127.0.0.1)",
    )
    parser.add_argument("--video", metavar="VIDEO", type=Path, help="video or pictures that a motion was made from")
    parser.add_argument(
        "--memory", default="1GB", help="of a viewer; beyond it the oldest data go (default 1GB; 25%% works too)"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing")


def run(args: argparse.Namespace) -> int:
    """Draw the input."""
    from drocap_ros.report.motion_images import each_image
    from drocap_ros.view.motion_view import Scene, draw_motion, new_recording

    _check(args)
    recording = new_recording(args.input.absolute().name or "input")
    with progress_bars(args.quiet) as progress:
        if is_session(args.input):
            motion, source = _motion_of_session(args.input, progress)
        else:
            (_, motion), source = read_motion(args.input), None
        source = args.video or source
        with _shown(recording, args):
            draw_motion(Scene(recording), motion, each_image(source, motion) if source else (), progress)
    return 0


def _motion_of_session(path: Path, progress: Progress) -> tuple[Motion, Path | None]:
    """The motion that the live graph found, and the source of its images, if the session holds them."""
    from drocap_ros.config import DrocapConfig
    from drocap_ros.live_replay import replay
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE

    motion, _ = replay(path, DrocapConfig(), progress)
    with open_session(path) as session:
        return motion, path if session.topics_of(COMPRESSED_IMAGE, IMAGE) else None


def is_session(path: Path) -> bool:
    """Whether the input is a recording; a folder of ours holds its motion beside its session."""
    from drocap_ros.recording.open_session import is_recording

    return path.exists() and is_recording(path) and not (path / "motion.npz").is_file()


def _check(args: argparse.Namespace) -> None:
    refusals = {
        "expected --save or --web, found both; choose one": args.save is not None and args.web,
        f"--port: expected 1 to 65534, got {args.port}; choose another": not 1 <= args.port <= 65534,
        f"--memory: expected an amount like 1GB or 25%, got {args.memory!r}; correct it": not re.fullmatch(
            r"[0-9]+(\.[0-9]+)?(%|[kKMGT]i?B)", args.memory
        ),
    }
    for words, refused in refusals.items():
        if refused:
            raise InputError(words)


@contextlib.contextmanager
def _shown(recording: rerun.RecordingStream, args: argparse.Namespace) -> Iterator[None]:
    """Take what is drawn inside to the file, window or browser that the user wants."""
    from drocap_ros.view.motion_view import has_screen, layout, to_browser, to_file, to_window

    arranged = layout()
    if args.save is not None:
        inputs = [args.input, args.video, *(path for path in args.input.glob("*") if path.suffix != ".rrd")]
        with output_file(args.save, inputs, "--save") as file:
            to_file(recording, file, arranged)
            try:
                yield
            finally:
                recording.disconnect()
        _say(args, f"written: {args.save} ({args.save.stat().st_size / 1e6:.1f} MB); `rerun {args.save}` shows it")
    elif args.web or not has_screen():
        server = to_browser(recording, arranged, args.host, args.port, args.memory)
        with server as address, contextlib.suppress(KeyboardInterrupt), interruptible() as interrupted:
            _say(args, f"open {address} in a browser; Ctrl-C stops")
            if has_screen():
                webbrowser.open(address)
            yield
            recording.flush()
            interrupted.wait()
    else:
        to_window(recording, arranged, args.memory)
        yield
        recording.flush()


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text, flush=True)
