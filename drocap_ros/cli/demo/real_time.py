"""The demo's flight in real time: each node is a process, and this machine's speed decides how late the images are."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.cli.demo.desk import NODES, Desk, longest_s
from drocap_ros.cli.demo.operator import REST_S, Operator

if TYPE_CHECKING:
    from drocap_ros.config import DrocapConfig


def fly_in_real_time(
    config: DrocapConfig, operator: Operator, say: Callable[[str], None], interrupted: threading.Event
) -> dict[str, float]:
    """Fly until the operator is done; returns the share of a processor core that each node used.

    Raises
    ------
    KeyboardInterrupt
        Soon after ``interrupted`` is set.
    DrocapError
        When the graph does not come up, a node fails, or the flight takes far longer than it can.
    """
    from drocap_ros.cli.graph.live import import_bringup

    with import_bringup().bringup(config, NODES, processes=True) as graph:
        Desk(graph.node, operator, say, time.monotonic)
        begin = time.monotonic()
        before = {name: _processor_s(graph.pid(name)) for name in NODES}
        graph.wait_until(lambda: operator.over or interrupted.is_set(), longest_s(operator), "the end of the flight")
        if interrupted.is_set():
            raise KeyboardInterrupt
        if operator.failure:
            graph.spin_for(REST_S)  # for the hold after the operator's last command
        passed = time.monotonic() - begin
        return {name: (_processor_s(graph.pid(name)) - before[name]) / passed for name in NODES}


def _processor_s(pid: int) -> float:
    """Processor time of a process so far, s; NaN after its end."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
