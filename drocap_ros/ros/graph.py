"""A running graph, as the script that started it uses it: readiness, activation, restarts, waiting."""

from __future__ import annotations

import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Protocol

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.task import Future

from drocap_ros.errors import InputError, NodeError
from drocap_ros.recording.session import Message
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.diagnostics import HARDWARE_ID, OK, WARN, Key, node_of, of, values_of
from drocap_ros.ros.lifecycle import ACTIVE, FINALIZED
from drocap_ros.ros.topics import TOPICS

#: A dead node is restarted at once; if it dies again, after pauses that double from this one ...
FIRST_PAUSE_S = 0.2
#: ... to this one.
LONGEST_PAUSE_S = 10.0
#: A node that dies more often than this within a minute ends the graph.
MOST_RESTARTS = 5


class Newest:
    """The last messages of a topic as they came; one that nobody asks for costs next to nothing.

    kept : (time of arrival, s, monotonic; bytes), the newest last
    """

    def __init__(self, node: Node, topic: str, keep: int = 1) -> None:
        self._message = TOPICS[topic].message
        self.kept: deque[tuple[float, bytes]] = deque(maxlen=keep)

        def take(data: bytes) -> None:
            self.kept.append((time.monotonic(), data))

        node.create_subscription(self._message, topic, take, TOPICS[topic].qos, raw=True)

    def age_s(self) -> float:
        """Time since the last message; infinite before the first."""
        return time.monotonic() - self.kept[-1][0] if self.kept else float("inf")

    def message(self) -> Message | None:
        """The last message; None before the first."""
        return self.read(self.kept[-1][1]) if self.kept else None

    def read(self, data: bytes) -> Message:
        """A message of the bytes of a kept one."""
        return deserialize_message(data, self._message)

    def stamped(self) -> dict[int, bytes]:
        """Stamp, ns -> bytes of the kept messages, whose first field is a header."""
        kept = [data for _, data in list(self.kept)]
        return {sec * 10**9 + ns: data for data in kept for sec, ns in [struct.unpack_from("<iI", data, 4)]}


class Managed:
    """A managed node of a running graph, in whichever process."""

    def __init__(self, node: Node, name: str) -> None:
        self._client = node.create_client(ChangeState, f"{name}/change_state")

    def set_active(self, active: bool) -> Future | None:
        """Ask it to work or to pause; the future of its answer, None = it is not there."""
        if not self._client.service_is_ready():
            return None
        number = Transition.TRANSITION_ACTIVATE if active else Transition.TRANSITION_DEACTIVATE
        return self._client.call_async(ChangeState.Request(transition=Transition(id=number)))


class Runner(Protocol):
    """One node, in a process or a thread."""

    name: str
    pid: int

    def check(self) -> None:
        """Raise the error of the node."""

    def stop(self) -> None:
        """Ask the node to stop and wait for it."""


class Graph:
    """A running graph.

    Readiness and life cycle of the nodes come from ``/diagnostics``, on which every node repeats them.

    node : an rclpy node in the graph's namespace, domain and context, for the script's own endpoints
    domain_id, namespace, names : place and nodes of the graph
    ready, finished : nodes whose endpoints are matched; sources that have published everything
    restarts : number of restarts by node
    events : restarts in words, the newest last
    respawn : whether a node that dies is restarted
    """

    def __init__(
        self, node: Node, domain_id: int, namespace: str, names: list[str], executor: Executor | None = None
    ) -> None:
        self.node = node
        self.domain_id = domain_id
        self.namespace = namespace
        self.names = names
        self.ready: set[str] = set()
        self.finished: set[str] = set()
        self.restarts: Counter[str] = Counter()
        self.events: deque[str] = deque(maxlen=100)
        self.respawn = False
        self._runners: list[Runner] = []
        self._start: Callable[[str, bool], Runner] | None = None
        self._active: set[str] = set()
        self._started_ns: dict[str, int] = {}
        self._status: DiagnosticStatus | None = None
        self._published_s = float("-inf")
        self._due_s: dict[str, float] = {}
        self._died_s: dict[str, deque[float]] = {}
        self._executor = executor or SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        entry = TOPICS["/diagnostics"]
        self._diagnostics = node.create_publisher(entry.message, "/diagnostics", entry.qos)
        if names:
            node.create_subscription(entry.message, "/diagnostics", self._on_diagnostics, entry.qos)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        stamp_ns = stamp_from_ros(message.header.stamp)
        for status in message.status:
            namespace, name = node_of(status)
            ours = status.hardware_id == HARDWARE_ID and namespace == self.namespace.strip("/")
            # Not the last words of the process before a restart.
            if not ours or name not in self.names or stamp_ns < self._started_ns.get(name, 0):
                continue
            values = values_of(status)
            if values.get(Key.READY) == "true":
                self.ready.add(name)
            if values.get(Key.LIFECYCLE) in (ACTIVE, FINALIZED):
                self._active.add(name)
            if values.get(Key.LIFECYCLE) == FINALIZED:
                self.finished.add(name)

    # -- start, restart, stop --------------------------------------------------------------------------

    def start(self, start: Callable[[str, bool], Runner]) -> None:
        """Start all nodes; ``start`` makes the runner of a node, which is restarted or not."""
        self._start = start
        for name in self.names:
            self._runners.append(start(name, False))

    def activate(self, *names: str, timeout_s: float) -> None:
        """Activate sources: they begin to publish."""
        clients = {name: self.node.create_client(ChangeState, f"{name}/change_state") for name in names}
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
        asked_s = dict.fromkeys(names, float("-inf"))

        def active() -> bool:
            # An answer may be lost; the node's diagnostics repeat its state.
            for name in set(names) - self._active:
                if time.monotonic() - asked_s[name] > 1.0 and clients[name].service_is_ready():
                    asked_s[name] = time.monotonic()
                    clients[name].call_async(request)
            return self._active >= set(names)

        self.wait_until(active, timeout_s, f"{', '.join(names)} to be active")
        for client in clients.values():
            self.node.destroy_client(client)

    def check(self) -> None:
        """Raise the error of a node; with ``respawn`` restart the node instead, up to a limit.

        Raises
        ------
        DrocapError
            The error itself from a node in this process; :class:`NodeError` with its words from another.
        """
        self._publish_status()
        for runner in list(self._runners):
            if runner.name in self._due_s:
                if time.monotonic() >= self._due_s[runner.name]:
                    self.restart(runner.name)
                continue
            try:
                runner.check()
            except Exception as error:
                if not self.respawn or not self._may_restart(runner.name, error):
                    raise

    def _may_restart(self, name: str, error: Exception) -> bool:
        now_s = time.monotonic()
        died_s = self._died_s.setdefault(name, deque(maxlen=MOST_RESTARTS))
        if len(died_s) == MOST_RESTARTS and now_s - died_s[0] < 60.0:
            return False
        recent = sum(now_s - at < 60.0 for at in died_s)
        died_s.append(now_s)
        pause_s = min(FIRST_PAUSE_S * 2.0 ** (recent - 1), LONGEST_PAUSE_S) if recent else 0.0
        self._due_s[name] = now_s + pause_s
        when = f" in {pause_s:g} s" if pause_s else ""
        self._report(WARN, f"{error}; restarting {name}{when}")
        return True

    def restart(self, name: str) -> None:
        """Restart a node: one that died, or a running one after it was stopped.

        It finds its peers by itself; :meth:`wait_ready` waits for that.  A recorder continues in a new folder beside
        the session's, so that the recording so far stays as it is.
        """
        index = next((i for i, runner in enumerate(self._runners) if runner.name == name), None)
        if index is None or self._start is None:
            raise InputError(f"restart: expected one of {', '.join(self.names)}; got {name}")
        self._due_s.pop(name, None)
        self._runners[index].stop()
        self._started_ns[name] = self.node.get_clock().now().nanoseconds
        self.ready.discard(name)
        self.finished.discard(name)
        self.restarts[name] += 1
        self._runners[index] = self._start(name, True)
        self._report(OK, f"{name} restarted, {self.restarts[name]} times so far")

    def stop(self) -> None:
        """Stop all nodes, from the sources downwards."""
        self.respawn = False
        self._due_s.clear()
        for runner in self._runners:
            runner.stop()

    def _report(self, level: bytes, text: str) -> None:
        self.events.append(text)
        self._status = DiagnosticStatus(
            level=level,
            name=f"{self.namespace.strip('/')}/bringup",
            message=text,
            hardware_id=HARDWARE_ID,
            values=[KeyValue(key=of(Key.RESTARTS, name), value=str(n)) for name, n in sorted(self.restarts.items())],
        )
        self._published_s = float("-inf")
        self._publish_status()

    def _publish_status(self) -> None:
        """Once a second, as nodes do, so that late subscribers receive it too."""
        if self._status is None or time.monotonic() - self._published_s < 1.0:
            return
        self._published_s = time.monotonic()
        message = DiagnosticArray(status=[self._status])
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    # -- waiting ---------------------------------------------------------------------------------------

    def wait_ready(self, *names: str, timeout_s: float = 60.0) -> None:
        """Wait until the endpoints of the named nodes are matched."""
        self.wait_until(
            lambda: self.ready >= set(names), timeout_s, f"the endpoints of {', '.join(names)} to be matched"
        )

    def wait_finished(self, *names: str, timeout_s: float) -> None:
        """Wait until the named sources have published everything."""
        self.wait_until(lambda: self.finished >= set(names), timeout_s, f"the end of {', '.join(names)}")

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Run the script's own callbacks until ``condition()`` holds; returns whether it does."""
        end_s = time.monotonic() + timeout_s
        while not (holds := condition()) and time.monotonic() <= end_s:
            self.check()
            self._executor.spin_once(timeout_sec=0.05)
        self.check()
        return holds

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str = "the condition") -> None:
        """Run the script's own callbacks until ``condition()`` holds.

        Raises NodeError when that takes longer than ``timeout_s``, or a node failed meanwhile.
        """
        if not self.wait(condition, timeout_s):
            raise NodeError(f"waited {timeout_s:g} s for {what}; it did not come")

    def spin_for(self, seconds: float, stop: threading.Event | None = None) -> None:
        """Run the script's own callbacks for some time, or until ``stop`` is set; raises the error of a node.

        The signal that sets ``stop`` may end the nodes too, which is no error then.
        """
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0 and not (stop and stop.is_set()):
            self.check()
            self._executor.spin_once(timeout_sec=min(left_s, 0.05))

    def pid(self, name: str) -> int:
        """Process of a node."""
        return next(runner.pid for runner in self._runners if runner.name == name)
