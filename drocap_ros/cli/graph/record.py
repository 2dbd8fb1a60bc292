"""``drocap record``: record a running graph."""

from __future__ import annotations

import argparse
from pathlib import Path

from drocap_ros.cli.graph.live import add_run_options, run_graph
from drocap_ros.cli.options import Subparsers, add_command, add_config_option


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "record",
        run,
        help="record a running graph",
        description="Record the topics of a running graph to a rosbag2 session (MCAP) until Ctrl-C.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="new folder of the session (default: named by date)")
    add_config_option(parser)
    add_run_options(parser)


def run(args: argparse.Namespace) -> int:
    """Record until the user interrupts."""
    from drocap_ros.config import load_config

    config = load_config(args.config)
    if args.out is not None:
        config = config.replace("session_recorder", session_dir=str(args.out.absolute()))
    return run_graph(config, ["session_recorder"], args)
