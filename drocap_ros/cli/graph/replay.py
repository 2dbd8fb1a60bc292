"""``drocap replay``: publish a session's topics again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from drocap_ros.cli.graph.live import add_graph_options


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "replay",
        help="publish a session's topics again",
        description="Publish the topics of a session again, with /clock, at the pace of the recording.",
    )
    parser.add_argument("session", metavar="SESSION", type=Path, help="session folder, .mcap, .bag or rosbag2 folder")
    parser.add_argument("--rate", type=float, default=1.0, help="times the speed of the recording (default 1)")
    parser.add_argument("--start", metavar="S", type=float, default=0.0, help="seconds into the recording (default 0)")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until Ctrl-C")
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="names, or their ends, e.g. pose2d (default: all but /diagnostics and /clock)",
    )
    parser.add_argument("--no-clock", action="store_true", help="do not publish /clock")
    add_graph_options(parser)
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Publish until the session ends or the user interrupts."""
    from drocap_ros.config import DrocapConfig
    from drocap_ros.errors import InputError

    if not 0 <= args.domain_id <= 101:
        raise InputError(f"--domain-id: expected 0 to 101, got {args.domain_id}")
    config = DrocapConfig().replace(
        "session_player",
        session=str(args.session.absolute()),
        rate=args.rate,
        start_s=args.start,
        loop=args.loop,
        topics=" ".join(args.topics),
        clock=not args.no_clock,
    )
    try:
        from drocap_ros.bringup import bringup
    except ImportError as error:
        raise InputError(f"expected ROS 2 with drocap_ros's messages, found none ({error}); run `make setup`") from None
    with bringup(
        config,
        ["session_player"],
        processes=not args.one_process,
        namespace=args.namespace,
        domain_id=args.domain_id,
    ) as graph:
        if not args.quiet:
            print(f"publishing {args.session} in domain {args.domain_id}; Ctrl-C stops", flush=True)
        try:
            while "session_player" not in graph.finished:
                end = graph.node.get_clock().now().nanoseconds + 500_000_000
                graph.wait_until(
                    lambda: "session_player" in graph.finished or graph.node.get_clock().now().nanoseconds > end,  # noqa: B023
                    60.0,
                )
        except KeyboardInterrupt:
            if not args.quiet:
                print("stopping")
    return 0
