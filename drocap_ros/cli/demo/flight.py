"""The demo's flight: the whole graph, with the flight simulator instead of drone and camera."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drocap_ros.cli.demo.operator import REST_S, Operator
from drocap_ros.errors import NodeError

if TYPE_CHECKING:
    from drocap_ros.bringup import Graph
    from drocap_ros.config import DrocapConfig

NODES = (
    "flight_simulator", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "visualizer",
    "session_recorder",
)  # fmt: skip


def fly(
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
        _Desk(graph, operator, say)
        begin = time.monotonic()
        before = {name: _processor_s(graph.pid(name)) for name in NODES}
        # Every wait of the operator is bounded; this bounds the whole.
        limit_s = 3.0 * operator.seconds + 120.0 * (operator.restarts + 1)
        graph.wait_until(lambda: operator.over or interrupted.is_set(), limit_s, "the end of the flight")
        if interrupted.is_set():
            raise KeyboardInterrupt
        if operator.failure:
            graph.spin_for(REST_S)  # for the hold after the operator's last command
        passed = time.monotonic() - begin
        return {name: (_processor_s(graph.pid(name)) - before[name]) / passed for name in NODES}


class _Desk:
    """Connects the operator with the graph: status and diagnostics in, commands out."""

    def __init__(self, graph: Graph, operator: Operator, say: Callable[[str], None]) -> None:
        from drocap_ros.ros.orbit_client import OrbitClient
        from drocap_ros.ros.topics import TOPICS

        self._graph, self._operator, self._say = graph, operator, say
        self._pilot = ""
        operator.cleared = False
        self._client = OrbitClient(graph.node)
        for topic, take in (("orbit/status", self._on_status), ("/diagnostics", self._on_diagnostics)):
            graph.node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)

    def _on_status(self, message: Any) -> None:
        from drocap_ros.flight.orbit.states import State

        command = self._operator.on_status(State(message.state), message.condition, message.reason, time.monotonic())
        if command is not None:
            self._client.send(int(command)).add_done_callback(self._on_answer)
        self._print_remarks()

    def _on_answer(self, future: Any) -> None:
        answer = future.result()
        self._operator.on_answer(answer.accepted, answer.condition, answer.words, time.monotonic())
        self._print_remarks()

    def _print_remarks(self) -> None:
        for words in self._operator.remarks:
            self._say(f"operator: {words}")
        self._operator.remarks.clear()

    def _on_diagnostics(self, message: Any) -> None:
        """Print what the pilot does, and clear the operator once the pilot has handed over."""
        from drocap_ros.ros.diagnostics import PILOT_HANDS_OFF, Key, node_of, values_of

        for status in message.status:
            if node_of(status)[1] != "flight_simulator":
                continue
            if values_of(status).get(Key.PILOT) == PILOT_HANDS_OFF:
                self._operator.cleared = True
            if status.message != self._pilot:
                self._pilot = status.message
                self._say(status.message)


def _processor_s(pid: int) -> float:
    """Processor time of a process so far, s; NaN after its end."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def check_flown(operator: Operator) -> None:
    """Refuse a flight with less than half of the wanted orbit.

    Raises
    ------
    NodeError
        With the reason.
    """
    if operator.orbited_s < 0.5 * operator.seconds:
        why = operator.failure or "; ".join(operator.holds) or "no hold was reported"
        busy = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        raise NodeError(
            f"demo: expected {operator.seconds:g} s of orbit, flew {operator.orbited_s:.1f} s: {why} ({busy})"
        )
