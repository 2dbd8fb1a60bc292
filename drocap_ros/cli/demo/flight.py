"""The demo's flight, in simulated or in real time: the graph's nodes, and the operator at their topics."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from drocap_ros.cli.demo.operator import REST_S, Operator
from drocap_ros.cli.graph.common import import_bringup
from drocap_ros.clip import Progress
from drocap_ros.errors import NodeError
from drocap_ros.recording.session import Message
from drocap_ros.ros.diagnostics import PILOT_HANDS_OFF, Key, node_of, values_of
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

    from drocap_ros.bringup import Graph, Lockstep
    from drocap_ros.config import DrocapConfig

#: The whole graph, with the flight simulator instead of drone and camera.
NODES = (
    "flight_simulator",
    "pose_estimator",
    "initializer",
    "bundle_adjuster",
    "mavlink_bridge",
    "visualizer",
    "session_recorder",
)
#: Prints a remark at a time of the flight, s.
Say = Callable[[float, str], None]


def fly_in_simulated_time(
    config: DrocapConfig, operator: Operator, say: Say, progress: Progress, interrupted: threading.Event
) -> str:
    """Fly until the operator is done: the same seed gives the same flight on any machine.

    Returns a sentence about the machine.

    raises KeyboardInterrupt : soon after ``interrupted`` is set
    raises DrocapError : when a node refuses its parameters or fails, or the flight takes far longer than it can
    """
    begin_s = time.monotonic()
    down, up = (Channel(lambda: graph.now_s, config.flight_simulator.seed + i) for i in (1, 2))
    transports = {"mavlink_bridge": LoopbackTransport(down, up), "flight_simulator": LoopbackTransport(up, down)}
    with _errors_only(), import_bringup().lockstep(config, NODES, transports=transports) as graph:
        bridge = next(node for node in graph.components if node.component == "mavlink_bridge")
        _Desk(graph, operator, bridge.requests.call, say, lambda: graph.now_s)
        graph.start()
        graph.run_until(_over(operator, progress, interrupted), _longest_s(operator), "the end of the flight")
        if operator.failure:
            graph.run_for(REST_S)  # for the hold after the operator's last command
        return f"simulated time: {graph.now_s:.1f} s in {time.monotonic() - begin_s:.1f} s on this machine"


def fly_in_real_time(
    config: DrocapConfig, operator: Operator, say: Say, progress: Progress, interrupted: threading.Event
) -> str:
    """Fly in real time, each node in a process: this machine's speed decides how late the images are.

    Arguments, result and errors are those of :func:`fly_in_simulated_time`.
    """
    from drocap_ros.ros.topics import RESULT_QOS, SERVICES

    with import_bringup().bringup(config, NODES, processes=True) as graph:
        client = graph.node.create_client(SERVICES["orbit/command"], "orbit/command", qos_profile=RESULT_QOS)
        begin_s = time.monotonic()
        _Desk(graph, operator, client.call_async, say, lambda: time.monotonic() - begin_s)
        before = {name: _processor_s(graph.pid(name)) for name in NODES}
        graph.wait_until(_over(operator, progress, interrupted), _longest_s(operator), "the end of the flight")
        if operator.failure:
            graph.spin_for(REST_S)  # for the hold after the operator's last command
        passed_s = time.monotonic() - begin_s
        shares = {name: (_processor_s(graph.pid(name)) - before[name]) / passed_s for name in NODES}
        return "processor: " + ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())


def check_flown(operator: Operator) -> None:
    """Refuse a flight with less than half of the wanted orbit.

    raises NodeError : with the reason
    """
    if operator.orbited_s < 0.5 * operator.seconds:
        why = operator.failure or "; ".join(operator.holds) or "no hold was reported"
        busy = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        raise NodeError(
            f"demo: expected {operator.seconds:g} s of orbit, flew {operator.orbited_s:.1f} s: {why} ({busy})"
        )


def _over(operator: Operator, progress: Progress, interrupted: threading.Event) -> Callable[[], bool]:
    """Whether the flight has ended; shows how much of the orbit is flown, and raises the user's interruption."""

    def over() -> bool:
        if interrupted.is_set():
            raise KeyboardInterrupt
        progress("orbit", min(1.0, operator.orbited_s / operator.seconds))
        return operator.over

    return over


def _longest_s(operator: Operator) -> float:
    """Longest time of a flight: every wait of the operator is bounded."""
    return 3.0 * operator.seconds + 120.0 * (operator.restarts + 1)


class _Answer(Protocol):
    """rclpy's future of the answer to a request."""

    def add_done_callback(self, callback: Callable[[_Answer], None]) -> None:
        """Call it with this future when the answer is there."""

    def result(self) -> Message:
        """The answer."""


class _Desk:
    """Connects the operator with the graph: status and diagnostics in, commands out.

    graph : its node is in the namespace of the nodes
    call : sends a request to the bridge; returns the future of its answer
    now_s : the operator's clock
    """

    def __init__(
        self,
        graph: Graph | Lockstep,
        operator: Operator,
        call: Callable[[Message], _Answer],
        say: Say,
        now_s: Callable[[], float],
    ) -> None:
        from drocap_ros.ros.topics import TOPICS

        self._node, self._operator, self._call, self._now_s = graph.node, operator, call, now_s
        self._say: Callable[[str], None] = lambda words: say(now_s(), words)
        self._pilot = ""
        operator.cleared = False
        for topic, take in (("orbit/status", self._on_status), ("/diagnostics", self._on_diagnostics)):
            graph.node.create_subscription(TOPICS[topic].message, topic, take, TOPICS[topic].qos)

    def _on_status(self, message: Message) -> None:
        from drocap_ros.flight.orbit.states import State
        from drocap_ros.ros.conversions import orbit_request

        command = self._operator.on_status(State(message.state), message.condition, message.reason, self._now_s())
        if command is not None:
            self._call(orbit_request(self._node, int(command))).add_done_callback(self._on_answer)
        self._print_remarks()

    def _on_answer(self, future: _Answer) -> None:
        answer = future.result()
        self._operator.on_answer(answer.accepted, answer.condition, answer.words, self._now_s())
        self._print_remarks()

    def _print_remarks(self) -> None:
        for words in self._operator.remarks:
            self._say(f"operator: {words}")
        self._operator.remarks.clear()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Print what the pilot does, and clear the operator once the pilot has handed over."""
        for status in message.status:
            if node_of(status)[1] != "flight_simulator":
                continue
            if values_of(status).get(Key.PILOT) == PILOT_HANDS_OFF:
                self._operator.cleared = True
            if status.message != self._pilot:
                self._pilot = status.message
                self._say(status.message)


@contextlib.contextmanager
def _errors_only() -> Iterator[None]:
    """The nodes report on /diagnostics; with a process each, their logs are not shown either."""
    logger = logging.getLogger("drocap_ros")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _processor_s(pid: int) -> float:
    """Processor time of a process so far, s; NaN after its end."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
