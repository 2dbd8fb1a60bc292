"""``drocap top``: the diagnostics of a running graph."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from drocap_ros.cli.graph.dashboard import dashboard_of
from drocap_ros.cli.graph.domain import add_domain_option, chosen_domain
from drocap_ros.cli.graph.live import import_bringup
from drocap_ros.cli.options import ros_namespace
from drocap_ros.cli.signals import stop_signals

#: How long ``--once`` waits for a first status, and then at most for further nodes.
ONCE_TIMEOUT_S = 8.0
#: All nodes have been heard when for so long none was new; each publishes its status once a second.
_QUIET_S = 1.5


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Add the command's options; ``run`` is its action."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "top",
        help="dashboard of a running graph",
        description="Show state, rate, latency and counts of every node of a running graph until Ctrl-C.",
    )
    parser.add_argument("--namespace", type=ros_namespace, default="/drocap", help="of the graph (default /drocap)")
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
            # Discovery may take seconds, for one node longer than for another.
            end_s = time.monotonic() + ONCE_TIMEOUT_S
            while not dashboard.heard(args.namespace) and time.monotonic() < end_s and not stop.is_set():
                graph.spin_for(0.2, stop)
            known: list[str] = []
            end_s = time.monotonic() + ONCE_TIMEOUT_S
            while dashboard.heard(args.namespace) != known and time.monotonic() < end_s and not stop.is_set():
                known = dashboard.heard(args.namespace)
                graph.spin_for(_QUIET_S, stop)
            if not known:
                print(
                    f"drocap: expected the status of a node in {args.namespace}, domain {domain_id}, found none; start"
                    " the graph, or correct --namespace or --domain-id",
                    file=sys.stderr,
                )
                return 1
            # A pipe has no width: wide enough that no name is cut.
            Console(width=None if sys.stdout.isatty() else 180).print(dashboard.table(args.namespace))
            return 0
        while not stop.is_set():
            graph.spin_for(0.5, stop)
            draw()
    return 0
