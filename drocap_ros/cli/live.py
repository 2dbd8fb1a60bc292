"""``drocap live``: bring the graph up on real hardware."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drocap_ros.bringup import Graph
    from drocap_ros.config import DrocapConfig

NODES = ("image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "session_recorder")


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "live",
        help="bring the graph up on real hardware",
        description="Start the nodes and run until the source ends or Ctrl-C. Each in a process of its own.",
    )
    parser.add_argument(
        "--config", metavar="FILE", type=Path, required=True, help="parameters of the components (YAML)"
    )
    parser.add_argument("--models", metavar="DIR", type=Path, help="folder of ONNX models (default: $DROCAP_MODELS)")
    parser.add_argument("--source", metavar="URI", help="instead of the configuration's image_ingest.source")
    parser.add_argument("--session", metavar="DIR", type=Path, help="record to this new folder")
    parser.add_argument("--nodes", nargs="+", choices=NODES, default=list(NODES), metavar="NODE", help=", ".join(NODES))
    add_graph_options(parser)
    parser.set_defaults(run=run)
    return parser


def add_graph_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that starts nodes."""
    parser.add_argument("--namespace", default="/drocap", help="of all topics (default /drocap)")
    parser.add_argument("--domain-id", type=int, default=0, metavar="N", help="DDS domain, 0 to 101 (default 0)")
    parser.add_argument("--one-process", action="store_true", help="all nodes in this process, a thread each")
    parser.add_argument("--quiet", action="store_true", help="no status line, only errors")


def run(args: argparse.Namespace) -> int:
    """Run the graph until its source has ended or the user interrupts."""
    from drocap_ros.config import load_config

    config = load_config(args.config)
    if args.source:
        config = config.replace("image_ingest", source=args.source)
    if args.models:
        config = config.replace("pose_estimator", models_dir=str(args.models.absolute()))
    if args.session:
        config = config.replace("session_recorder", session_dir=str(args.session.absolute()))
    return run_graph(config, args.nodes, args)


def run_graph(config: DrocapConfig, nodes: list[str], args: argparse.Namespace) -> int:
    """Bring nodes up, show what they say, stop on Ctrl-C or when the source has ended."""
    from drocap_ros.errors import InputError

    if not 0 <= args.domain_id <= 101:
        raise InputError(f"--domain-id: expected 0 to 101, got {args.domain_id}")
    try:
        from drocap_ros.bringup import bringup
    except ImportError as error:
        raise InputError(f"expected ROS 2 with drocap_ros's messages, found none ({error}); run `make setup`") from None
    from drocap_ros.cli.dashboard import dashboard_on_terminal
    from drocap_ros.nodes.topics import TOPICS

    with bringup(
        config, nodes, processes=not args.one_process, namespace=args.namespace, domain_id=args.domain_id
    ) as graph:
        if not args.quiet:
            print(f"running {', '.join(graph.names)} in {args.namespace}, domain {args.domain_id}; Ctrl-C stops")
            sys.stdout.flush()
        with dashboard_on_terminal(not args.quiet) as (dashboard, draw):
            entry = TOPICS["/diagnostics"]
            graph.node.create_subscription(entry.message, "/diagnostics", dashboard.take, entry.qos)
            with contextlib.suppress(KeyboardInterrupt):
                _watch(graph, "image_ingest" in nodes, draw)
    return 0


def _watch(graph: Graph, until_source_ends: bool, draw: Callable[[], None]) -> None:
    while not (until_source_ends and "image_ingest" in graph.finished):
        graph.spin_for(0.5)
        draw()
