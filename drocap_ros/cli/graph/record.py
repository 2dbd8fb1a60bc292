"""``drocap record``: record a running graph."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from drocap_ros.cli.graph.live import add_graph_options, run_graph


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "record",
        help="record a running graph",
        description="Record the topics of a running graph to a rosbag2 session (MCAP) until Ctrl-C.",
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="new folder of the session (default: named by date)")
    parser.add_argument("--config", metavar="FILE", type=Path, help="parameters of the components (YAML)")
    add_graph_options(parser)
    parser.add_argument("--no-respawn", action="store_true", help="end when a node dies instead of restarting it")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Record until the user interrupts."""
    from drocap_ros.config import load_config

    config = load_config(args.config)
    if args.out is not None:
        config = config.replace("session_recorder", session_dir=str(args.out.absolute()))
    return run_graph(config, ["session_recorder"], args)
