"""The demo's flight: the whole graph with the flight simulator in the place of drone and camera."""

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
#: What the flight simulator says once its pilot's hands are off.
HANDED_OVER = "pilot: hands off"


def fly(
    config: DrocapConfig, operator: Operator, say: Callable[[str], None], interrupted: threading.Event
) -> dict[str, float]:
    """Fly until the operator is done; returns the share of a processor core that each node took.

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
            graph.spin_for(REST_S)  # for the hold that the operator's last word asked for
        passed = time.monotonic() - begin
        return {name: (_processor_s(graph.pid(name)) - before[name]) / passed for name in NODES}


class _Desk:
    """The operator's desk: what the bridge and the others say, and the button."""

    def __init__(self, graph: Graph, operator: Operator, say: Callable[[str], None]) -> None:
        from drocap_ros.ros.topics import TOPICS

        self._graph, self._operator, self._say = graph, operator, say
        self._told: dict[str, str] = {}
        operator.cleared = False
        self._command = graph.node.create_publisher(
            TOPICS["orbit/command"].message, "orbit/command", TOPICS["orbit/command"].qos
        )
        for topic, take in (("orbit/status", self._on_status), ("/diagnostics", self._on_diagnostics)):
            graph.node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)

    def _on_status(self, message: Any) -> None:
        from std_msgs.msg import Header

        from drocap_ros.flight.orbit.safety import State
        from drocap_ros.msg import OrbitCommand

        operator = self._operator
        command = operator.look(State(message.state), message.reason, time.monotonic())
        for words in operator.said:
            self._say(f"operator: {words}")
        operator.said.clear()
        if command is not None:
            nan = float("nan")
            now = self._graph.node.get_clock().now().to_msg()
            self._command.publish(
                OrbitCommand(
                    header=Header(stamp=now), command=int(command), radius_m=nan, height_m=nan, angular_speed_deg_s=nan
                )
            )

    def _on_diagnostics(self, message: Any) -> None:
        """Pass on what the pilot does."""
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            if name == "flight_simulator" and status.message != self._told.get(name):
                self._told[name] = status.message
                self._say(status.message)
                self._operator.cleared = self._operator.cleared or status.message == HANDED_OVER


def _processor_s(pid: int) -> float:
    """Time that a process has spent on the processor so far, s; NaN once it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def check_flown(operator: Operator) -> None:
    """Refuse a flight of which less than half of the wanted orbit was flown.

    Raises
    ------
    NodeError
        With the reason.
    """
    if operator.orbited_s < 0.5 * operator.seconds:
        why = operator.failure or "; ".join(operator.holds) or "nothing was said"
        busy = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        raise NodeError(
            f"demo: expected {operator.seconds:g} s of orbit, flew {operator.orbited_s:.1f} s: {why} ({busy})"
        )
