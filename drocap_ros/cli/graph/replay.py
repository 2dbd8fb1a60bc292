"""``drocap replay``: publish a session's topics again."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.graph.common import add_start_options
from drocap_ros.cli.graph.live import run_graph
from drocap_ros.cli.options import Subparsers, add_command


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "replay",
        run,
        help="publish a session's topics again",
        description="Publish the topics of a session again, with /clock, at the speed of the recording.",
    )
    parser.add_argument("session", metavar="SESSION", type=Path, help="session folder, .mcap, .bag or rosbag2 folder")
    parser.add_argument("--rate", type=float, default=1.0, help="times the speed of the recording (default 1)")
    parser.add_argument("--start", metavar="S", type=float, default=0.0, help="seconds into the recording (default 0)")
    parser.add_argument(
        "--delay",
        metavar="S",
        type=float,
        default=3.0,
        help="seconds before the first message, in which running subscribers find the player (default 3)",
    )
    parser.add_argument("--loop", action="store_true", help="repeat until Ctrl-C")
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="names, or their ends, e.g. pose2d (default: all but /diagnostics and /clock)",
    )
    parser.add_argument("--no-clock", action="store_true", help="do not publish /clock")
    add_start_options(parser)
    parser.set_defaults(no_respawn=True)  # a restarted player would begin again


def run(args: argparse.Namespace) -> int:
    """Publish until the session ends or the user interrupts."""
    from drocap_ros.config import DrocapConfig

    config = DrocapConfig().replace(
        "session_player",
        session=str(args.session.absolute()),
        rate=args.rate,
        start_s=args.start,
        delay_s=args.delay,
        loop=args.loop,
        topics=" ".join(args.topics),
        clock=not args.no_clock,
    )
    return run_graph(config, ["session_player"], args)
