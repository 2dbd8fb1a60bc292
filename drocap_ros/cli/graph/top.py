"""``drocap top``: the diagnostics of a running graph as a table."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from drocap_ros.cli.graph.common import PIPE_WIDTH, add_place_options, chosen_domain, import_bringup
from drocap_ros.cli.options import Subparsers, add_command
from drocap_ros.cli.running import stop_signals
from drocap_ros.ros.diagnostics import Key, number, values_of, words

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray
    from rich.table import Table

    from drocap_ros.bringup import Graph

#: How long ``--once`` waits for a first status, and then at most for further nodes: discovery may take seconds.
ONCE_TIMEOUT_S = 8.0
#: Words and colours of the levels of diagnostic_msgs/DiagnosticStatus.
_LEVELS = {0: ("ok", "green"), 1: ("warning", "yellow"), 2: ("error", "red"), 3: ("stale", "magenta")}
_LATENCY = (Key.LATENCY_P50, Key.LATENCY_P95, Key.LATENCY_P99)
_SHOWN = (Key.SUBJECT, Key.LAST_REFUSED)


COLUMNS = ("node", "state", "Hz", "latency, ms (p50 / p95 / p99)", "status", "counts")


class Dashboard:
    """Latest ``/diagnostics`` status of each node."""

    def __init__(self) -> None:
        self._rows: dict[str, tuple[int, str, dict[str, str]]] = {}

    def take(self, message: DiagnosticArray) -> None:
        """Store the statuses of a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            # rclpy gives the level as one byte.
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            self._rows[status.name] = (level, status.message, values_of(status))

    def heard(self, namespace: str) -> list[str]:
        """Names of the nodes whose status has arrived, in a namespace."""
        inside = f"{namespace.strip('/')}/" if namespace else ""
        return sorted(name for name in self._rows if name.startswith(inside))

    def rows(self, namespace: str = "") -> list[dict[str, str]]:
        """Row of each node whose status has arrived, in a namespace: words by column, and the colour of its state."""
        return [self._row(name, *self._rows[name]) for name in self.heard(namespace)]

    def _row(self, name: str, level: int, text: str, values: dict[str, str]) -> dict[str, str]:
        counts = ", ".join(
            f"{words(key)} {value}"
            for key, value in values.items()
            if key != Key.PASSED_OVER and (value.isdigit() or key in _SHOWN)
        )
        state, colour = _LEVELS.get(level, (str(level), "white"))
        latency = " / ".join(f"{number(values[key]):.0f}" for key in _LATENCY if key in values)
        cells = (name, state, values.get(Key.RATE, ""), latency, text, counts)
        return dict(zip(COLUMNS, cells, strict=True)) | {"colour": colour}

    def is_active(self, name: str) -> bool | None:
        """Whether a managed node works; None = it is not there."""
        lifecycle = self._rows[name][2].get(Key.LIFECYCLE) if name in self._rows else None
        return None if lifecycle is None else lifecycle == "active"

    def table(self, namespace: str = "") -> Table:
        """Table of the nodes whose status has arrived, in a namespace."""
        from rich.table import Table
        from rich.text import Text

        table = Table(*COLUMNS, expand=True)
        for row in self.rows(namespace):
            # As Text: words of nodes, and of messages that they refused, may hold brackets, which are markup.
            shown, _, rate, latency, status, amounts = (row[name] for name in COLUMNS)
            state = Text(row["state"], row["colour"])
            table.add_row(Text(shown), state, Text(rate), latency, Text(status), Text(amounts))
        table.caption = Text(self._keeping_up(self.heard(namespace)))
        return table

    def _keeping_up(self, names: list[str]) -> str:
        """Whether this machine is fast enough, in words; "" before any node knows."""
        shares = {name: number(self._rows[name][2].get(Key.PASSED_OVER, "")) for name in names}
        known = {name: share for name, share in shares.items() if share >= 0}
        if not known:
            return ""
        slow = {name: share for name, share in known.items() if share >= 1}
        if not slow:
            return "this machine keeps up"
        return "this machine passes over " + ", ".join(f"{n:.0f} % in {name}" for name, n in slow.items())


@contextlib.contextmanager
def dashboard_of(graph: Graph, show: bool) -> Iterator[tuple[Dashboard, Callable[[], None]]]:
    """Dashboard of the graph's ``/diagnostics``, and the function that draws it: not in a pipe or without ``show``."""
    from drocap_ros.ros.topics import TOPICS

    dashboard, entry = Dashboard(), TOPICS["/diagnostics"]
    graph.node.create_subscription(entry.message, "/diagnostics", dashboard.take, entry.qos)
    if not show or not sys.stdout.isatty():
        yield dashboard, lambda: None
        return
    from rich.live import Live

    with Live(dashboard.table(graph.namespace), auto_refresh=False) as live:
        yield dashboard, lambda: live.update(dashboard.table(graph.namespace), refresh=True)


def add_parser(subparsers: Subparsers) -> None:
    """Add the command's options; ``run`` is its action."""
    parser = add_command(
        subparsers,
        "top",
        run,
        help="dashboard of a running graph",
        description="Show state, rate, latency and counts of every node of a running graph until Ctrl-C.",
    )
    add_place_options(parser)
    parser.add_argument("--once", action="store_true", help="print the table once and end")


def run(args: argparse.Namespace) -> int:
    """Subscribe and draw; status 1 with ``--once`` when no status arrived."""
    domain_id = chosen_domain(args)
    with (
        import_bringup().watch(args.namespace, domain_id) as graph,
        dashboard_of(graph, show=not args.once) as (dashboard, draw),
        stop_signals() as stop,
    ):
        if args.once:
            return _print_once(graph, dashboard, stop.is_set)
        while not stop.is_set():
            graph.spin_for(0.5, stop)
            draw()
    return 0


def _print_once(graph: Graph, dashboard: Dashboard, stopped: Callable[[], bool]) -> int:
    namespace = graph.namespace
    graph.wait(lambda: bool(dashboard.heard(namespace)) or stopped(), ONCE_TIMEOUT_S)
    known: list[str] = []

    def all_heard() -> bool:
        before, known[:] = known.copy(), dashboard.heard(namespace)
        # All nodes have been heard when for so long none was new; each publishes its status once a second.
        return stopped() or known == before or graph.wait(stopped, 1.5)

    graph.wait(all_heard, ONCE_TIMEOUT_S)
    if not known:
        print(
            f"drocap: expected the status of a node in {namespace}, domain {graph.domain_id}, found none; start"
            " the graph, or correct --namespace or --domain-id",
            file=sys.stderr,
        )
        return 1
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else PIPE_WIDTH).print(dashboard.table(namespace))
    return 0
