"""The operator's desk of the demo: status and diagnostics in, commands out."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from drocap_ros.cli.demo.operator import Operator
from drocap_ros.errors import NodeError

#: The whole graph, with the flight simulator instead of drone and camera.
NODES = (
    "flight_simulator", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "visualizer",
    "session_recorder",
)  # fmt: skip


class Desk:
    """Connects the operator with the graph.

    commands : answers that are to come or have come, in the order of the commands

    Parameters
    ----------
    node : of the graph's namespace, with which it acts
    now_s : the operator's clock
    """

    def __init__(
        self, node: Any, operator: Operator, say: Callable[[str], None], now_s: Callable[[], float]
    ) -> None:  # fmt: skip
        from drocap_ros.ros.orbit_client import OrbitClient
        from drocap_ros.ros.topics import TOPICS

        self._operator, self._say, self._now_s = operator, say, now_s
        self.commands: list[Any] = []
        self._pilot = ""
        operator.cleared = False
        self._client = OrbitClient(node)
        for topic, take in (("orbit/status", self._on_status), ("/diagnostics", self._on_diagnostics)):
            node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)

    def answered(self) -> int:
        """Number of answered commands."""
        return sum(command.done() for command in self.commands)

    def _on_status(self, message: Any) -> None:
        from drocap_ros.flight.orbit.states import State

        command = self._operator.on_status(State(message.state), message.condition, message.reason, self._now_s())
        if command is not None:
            future = self._client.send(int(command))
            self.commands.append(future)
            future.add_done_callback(self._on_answer)
        self._print_remarks()

    def _on_answer(self, future: Any) -> None:
        answer = future.result()
        self._operator.on_answer(answer.accepted, answer.condition, answer.words, self._now_s())
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


def longest_s(operator: Operator) -> float:
    """Longest time of a flight: every wait of the operator is bounded."""
    return 3.0 * operator.seconds + 120.0 * (operator.restarts + 1)


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
