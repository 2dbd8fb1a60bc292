"""``drocap view``: a motion, a recording or a running graph in the Rerun viewer."""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.atomic_output import output_file
from drocap_ros.cli.graph.common import add_domain_option, chosen_domain, import_bringup
from drocap_ros.cli.options import Subparsers, add_command, read_motion, ros_namespace
from drocap_ros.cli.running import interruptible, progress_bars, stop_signals
from drocap_ros.errors import InputError

if TYPE_CHECKING:
    import rerun

    from drocap_ros.bringup import Graph
    from drocap_ros.recording.session import Message
    from drocap_ros.view.message_view import MessageView

#: Of the web page; the next one carries the data.
PORT = 9090
#: A browser decodes no more pictures of a running graph than this; a file holds them all.
LIVE_PICTURE_HZ = 10.0


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "view",
        run,
        help="a motion, a recording or a running graph in 3D",
        description="Show a motion, a recording or a running graph in the Rerun viewer: body, uncertainty, camera and "
        "picture over the time of the images, delays and errors. In a window, or in a browser where there is no "
        "screen or with --web.",
    )
    parser.add_argument(
        "input",
        metavar="INPUT",
        type=Path,
        nargs="?",
        help="motion.npz or the folder that holds it; session folder, .mcap, .bag or rosbag2 folder",
    )
    parser.add_argument("--live", action="store_true", help="show a running graph until Ctrl-C")
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
        "--namespace",
        type=ros_namespace,
        help="of the topics (default: /drocap live, that of the keypoints otherwise)",
    )
    add_domain_option(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="end a --live view after so long")
    parser.add_argument(
        "--memory", default="1GB", help="of a viewer; beyond it the oldest data go (default 1GB; 25%% works too)"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing")


def run(args: argparse.Namespace) -> int:
    """Draw the input, or the graph until the user interrupts."""
    from drocap_ros.view.rerun_output import new_recording

    _check(args)
    if args.live:
        return _view_live(new_recording("live"), args)
    recording = new_recording(args.input.absolute().name or "input")
    if is_session(args.input):
        _view_session(recording, args)
    else:
        _view_motion(recording, args)
    return 0


def is_session(path: Path) -> bool:
    """Whether the input is a recording; a folder of ours holds its motion beside its session."""
    from drocap_ros.recording.open_session import is_recording

    return path.exists() and is_recording(path) and not (path / "motion.npz").is_file()


def _check(args: argparse.Namespace) -> None:
    if args.live or args.domain_id is not None:
        chosen_domain(args)
    refusals = {
        f"expected INPUT or --live, found {'both' if args.live else 'neither'}; name what to show": args.live
        == (args.input is not None),
        "--video: expected a motion with it, found --live; leave it out": args.live and args.video is not None,
        "--seconds: expected more than 0, and --live with it; correct or leave it out": args.seconds is not None
        and not (args.live and args.seconds > 0),
        "expected --save or --web, found both; choose one": args.save is not None and args.web,
        f"--port: expected 1 to 65534, got {args.port}; choose another": not 1 <= args.port <= 65534,
        f"--memory: expected an amount like 1GB or 25%, got {args.memory!r}; correct it": not re.fullmatch(
            r"[0-9]+(\.[0-9]+)?(%|[kKMGT]i?B)", args.memory
        ),
    }
    for words, refused in refusals.items():
        if refused:
            raise InputError(words)


def _view_motion(recording: rerun.RecordingStream, args: argparse.Namespace) -> None:
    from drocap_ros.report.motion_images import each_image
    from drocap_ros.view.motion_view import PLOTS, draw_motion
    from drocap_ros.view.rerun_scene import Scene

    _, motion = read_motion(args.input)
    pictures = each_image(args.video, motion) if args.video else ()
    with _shown(recording, PLOTS, args), progress_bars(args.quiet) as progress:
        draw_motion(Scene(recording), motion, pictures, progress)


def _view_session(recording: rerun.RecordingStream, args: argparse.Namespace) -> None:
    from drocap_ros.recording.open_session import open_session
    from drocap_ros.view.message_view import PLOTS, MessageView, draw_session
    from drocap_ros.view.rerun_scene import Scene

    if args.video is not None:
        raise InputError("--video: expected a motion with it, found a recording; leave it out")
    with open_session(args.input) as session:
        with _shown(recording, (*PLOTS, "log"), args):
            view = MessageView(Scene(recording))
            with progress_bars(args.quiet) as progress:
                draw_session(view, session, args.namespace, progress)
        for warning in session.warnings:
            print(f"drocap: warning: {warning}", file=sys.stderr)
        _warn_refused(view)


def _view_live(recording: rerun.RecordingStream, args: argparse.Namespace) -> int:
    from drocap_ros.view.message_view import PLOTS, MessageView
    from drocap_ros.view.rerun_scene import Scene

    namespace, domain_id = args.namespace or "/drocap", chosen_domain(args)
    with import_bringup().watch(namespace, domain_id) as graph, _shown(recording, (*PLOTS, "log"), args):
        view = MessageView(Scene(recording), image_hz=0.0 if args.save else LIVE_PICTURE_HZ)
        view.namespace = namespace
        _subscribe(graph, view)
        end = math.inf if args.seconds is None else time.monotonic() + args.seconds
        with stop_signals() as stop:
            while not stop.is_set() and (left := end - time.monotonic()) > 0:
                graph.spin_for(min(0.2, left))
        view.finish()
    _warn_refused(view)
    if not view.taken:
        print(f"drocap: heard nothing of {namespace} in domain {domain_id}; is it running there?", file=sys.stderr)
    return 0 if view.taken else 1


def _subscribe(graph: Graph, view: MessageView) -> None:
    from drocap_ros.ros.topics import TOPICS

    def receiver(name: str) -> Callable[[Message], None]:
        return lambda message: view.take(name, message, graph.node.get_clock().now().nanoseconds)

    for name in view.handlers:
        entry = TOPICS[name]
        graph.node.create_subscription(entry.message, name, receiver(name), entry.qos)


@contextlib.contextmanager
def _shown(recording: rerun.RecordingStream, views: tuple[str, ...], args: argparse.Namespace) -> Iterator[None]:
    """Take what is drawn inside to the file, window or browser that the user wants."""
    from drocap_ros.view.rerun_output import has_screen, to_browser, to_file, to_window
    from drocap_ros.view.rerun_scene import layout

    arranged = layout(views, follow=args.live)
    if args.save is not None:
        inside = args.input.glob("*") if args.input else ()
        inputs = [args.input, args.video, *(path for path in inside if path.suffix != ".rrd")]
        with output_file(args.save, inputs, "--save") as file:
            to_file(recording, file, arranged)
            try:
                yield
            finally:
                recording.disconnect()
        _say(args, f"written: {args.save} ({args.save.stat().st_size / 1e6:.1f} MB); `rerun {args.save}` shows it")
    elif args.web or not has_screen():
        server = to_browser(recording, arranged, args.host, args.port, args.memory, newest_first=args.live)
        with server as address, contextlib.suppress(KeyboardInterrupt), interruptible() as interrupted:
            _say(args, f"open {address} in a browser; Ctrl-C stops")
            if has_screen():
                webbrowser.open(address)
            yield
            recording.flush()
            if not args.live:
                interrupted.wait()
    else:
        to_window(recording, arranged, args.memory)
        yield
        recording.flush()


def _warn_refused(view: MessageView) -> None:
    if view.refused:
        print(f"drocap: warning: {view.refused} malformed messages were not drawn; see the log view", file=sys.stderr)


def _say(args: argparse.Namespace, text: str) -> None:
    if not args.quiet:
        print(text, flush=True)
