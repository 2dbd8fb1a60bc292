"""The nodes' diagnostics as a table on a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from drocap_ros.ros.diagnostics import Key, number, words

if TYPE_CHECKING:
    from rich.table import Table

    from drocap_ros.bringup import Graph

_COLOURS = {0: "green", 1: "yellow", 2: "red", 3: "magenta"}
_LATENCY = (Key.LATENCY_P50, Key.LATENCY_P95, Key.LATENCY_P99)
_SHOWN = (Key.SUBJECT, Key.LAST_REFUSED)
_LEVELS = {0: "ok", 1: "warning", 2: "error", 3: "stale"}


class Dashboard:
    """Latest ``/diagnostics`` status of each node."""

    def __init__(self) -> None:
        self._rows: dict[str, tuple[int, str, dict[str, str]]] = {}

    def take(self, message: Any) -> None:
        """Store the statuses of a diagnostic_msgs/DiagnosticArray."""
        for status in message.status:
            values = {value.key: value.value for value in status.values}
            # rclpy gives the level as one byte.
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            self._rows[status.name] = (level, status.message, values)

    def heard(self, namespace: str) -> list[str]:
        """Names of the nodes whose status has arrived, in a namespace."""
        inside = f"{namespace.strip('/')}/" if namespace else ""
        return sorted(name for name in self._rows if name.startswith(inside))

    def table(self, namespace: str = "") -> Table:
        """Table of the nodes whose status has arrived, in a namespace."""
        from rich.table import Table
        from rich.text import Text

        table = Table("node", "state", "Hz", "latency, ms (p50 / p95 / p99)", "status", "counts", expand=True)
        for name in self.heard(namespace):
            level, text, values = self._rows[name]
            counts = ", ".join(
                f"{words(key)} {value}" for key, value in values.items() if value.isdigit() or key in _SHOWN
            )
            state = f"[{_COLOURS.get(level, 'white')}]{_LEVELS.get(level, str(level))}[/]"
            latency = " / ".join(f"{number(values[key]):.0f}" for key in _LATENCY if key in values)
            # Words of nodes, and of messages that they refused, may hold brackets, which are markup in a plain string.
            table.add_row(Text(name), state, Text(values.get(Key.RATE, "")), latency, Text(text), Text(counts))
        return table


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
