"""``drocap top``: the diagnostics of a running graph."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from drocap_ros.cli.graph.domain import add_domain_option, chosen_domain
from drocap_ros.cli.graph.live import dashboard_of, import_bringup, stop_signals

#: How long ``--once`` waits for a first status.
ONCE_TIMEOUT_S = 8.0


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "top",
        help="dashboard of a running graph",
        description="Show state, rate, latency and counts of every node of a running graph until Ctrl-C.",
    )
    parser.add_argument("--namespace", default="/drocap", help="of the graph (default /drocap)")
    add_domain_option(parser)
    parser.add_argument("--once", action="store_true", help="print the table once and end")
    parser.set_defaults(run=run)
    return parser


def run(args: argparse.Namespace) -> int:
    """Subscribe and draw; status 1 with ``--once`` when no status arrived."""
    from rich.console import Console

    domain_id = chosen_domain(args)
    with (
        import_bringup().watch(args.namespace, domain_id) as graph,
        dashboard_of(graph, show=not args.once) as (dashboard, draw),
        stop_signals() as stop,
    ):
        if args.once:
            # Discovery may take seconds; then every node publishes its status once a second.
            for _ in range(int(ONCE_TIMEOUT_S)):
                graph.spin_for(1.0)
                if dashboard.heard(args.namespace):
                    graph.spin_for(1.5)
                    break
            # A pipe has no width: wide enough that no name is cut.
            Console(width=None if sys.stdout.isatty() else 180).print(dashboard.table(args.namespace))
            return 0 if dashboard.heard(args.namespace) else 1
        while not stop.is_set():
            graph.spin_for(0.5)
            draw()
    return 0
