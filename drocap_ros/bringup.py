"""Start any subset of the nodes from one configuration, without ``ros2 launch``.

    with bringup(config, ["image_ingest", "pose_estimator", "session_recorder"]) as graph:
        graph.wait_finished("image_ingest", timeout_s=60)

On entry every publisher and subscriber among the chosen nodes has found its peers, and only then the sources
begin: nothing is lost at the start.  On exit the nodes stop from the sources downwards, each working off
what has arrived, and what a node raised is raised here.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Empty, String

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import DrocapError, InputError, NodeError
from drocap_ros.ros.component import HARDWARE_ID, ComponentNode
from drocap_ros.ros.fastdds import PROFILE_FILE, PROFILE_VARIABLE
from drocap_ros.ros.processes import (
    DEFAULT_NAMESPACE,
    STOP_TIMEOUT_S,
    NodeProcess,
    Place,
    Spare,
    hears_a_driver,
    node_class,
    remaps,
)
from drocap_ros.ros.spin import spin, step_back
from drocap_ros.ros.topics import GRAPH_QOS, NODES, TOPICS

#: In one process all nodes share Python's lock.  At its usual 5 ms the pose would wait that long for the adjuster after
#: each call that lets the lock go, several times per picture.
SWITCH_INTERVAL_S = 0.0005

#: A dead node is started again at once, and if it dies again, after pauses: the first, and the longest; each is twice
#: the one before.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 10.0
#: A node that dies more often than this within a minute is given up, and the graph with it.
MOST_RESTARTS = 5
#: A process in reserve is started this long after all nodes are there, whose first work it would hold up; one that died
#: unused is replaced after a longer time.
SPARE_REST_S, SPARE_PAUSE_S = 2.0, 60.0


class Graph:
    """A running graph, as the script that started it sees it.

    node : an rclpy node in the graph's namespace, domain and context, for the script's own endpoints
    domain_id, namespace, names : where the graph runs and what runs in it
    """

    def __init__(self, node: Node, domain_id: int, namespace: str, names: list[str]) -> None:
        self.node = node
        self.domain_id = domain_id
        self.namespace = namespace
        self.names = names
        self.ready: set[str] = set()
        self.finished: set[str] = set()
        self.restarts: Counter[str] = Counter()
        #: What happened to nodes, in words, for whoever shows it; the newest last.
        self.events: deque[str] = deque(maxlen=100)
        self._runners: list[_Runner] = []
        self._make: Callable[[str], _Runner] | None = None
        self._respawn = False
        self._reserve: Callable[[], Spare] | None = None
        self._spare: Spare | None = None
        self._spare_s = -math.inf
        self._status: DiagnosticStatus | None = None
        self._told_s = -math.inf
        self._due_s: dict[str, float] = {}
        self._died_s: dict[str, deque[float]] = {}
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._start = node.create_publisher(Empty, "graph/start", GRAPH_QOS)
        entry = TOPICS["/diagnostics"]
        self._diagnostics = node.create_publisher(entry.message, "/diagnostics", entry.qos)
        self._collect("graph/ready", self.ready)
        self._collect("graph/finished", self.finished)

    def _collect(self, topic: str, names: set[str]) -> None:
        def add(message: Any) -> None:
            names.add(message.data)

        self.node.create_subscription(String, topic, add, GRAPH_QOS)

    def check(self) -> None:
        """Raise what a node raised; with ``respawn``, start it again instead, as long as that helps.

        Raises
        ------
        DrocapError
            The error itself from a node in this process; :class:`NodeError` with its words from another.
        """
        self._tell_again()
        self._keep_spare()
        for runner in list(self._runners):
            if runner.name in self._due_s:
                if time.monotonic() >= self._due_s[runner.name]:
                    self.restart(runner.name)
                continue
            try:
                runner.check()
            except Exception as error:
                if not self._respawn or not self._may_restart(runner.name, error):
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
        self._tell(f"{error}; starting {name} again{when}", DiagnosticStatus.WARN)
        return True

    def restart(self, name: str) -> None:
        """Start a node anew: one that died, or a running one after it was stopped.

        It finds its peers by itself; :meth:`wait_ready` waits for that.  A recorder goes on in a new folder beside
        the session's, so that what was recorded stays as it is.

        Raises
        ------
        InputError
            When no such node was brought up here.
        """
        index = next((i for i, runner in enumerate(self._runners) if runner.name == name), None)
        if index is None or self._make is None:
            raise InputError(f"restart: expected one of {', '.join(self.names)}; got {name}")
        self._due_s.pop(name, None)
        self._runners[index].stop()
        self.ready.discard(name)
        self.finished.discard(name)
        self.restarts[name] += 1
        self._runners[index] = self._make(name)
        self._tell(f"{name} started again, {self.restarts[name]} times so far", DiagnosticStatus.OK)

    def _keep_spare(self) -> None:
        """Have a process in reserve, but not while a node has yet to find its place."""
        now_s = time.monotonic()
        if self._reserve is None:
            return
        if self._spare is not None and self._spare.process.poll() is not None:
            self._take_spare()
            self._spare_s = now_s + SPARE_PAUSE_S
        elif not self.ready >= set(self.names):
            self._spare_s = max(self._spare_s, now_s + SPARE_REST_S)
        elif self._spare is None and now_s >= self._spare_s:
            self._spare = self._reserve()

    def _take_spare(self) -> Spare | None:
        spare, self._spare = self._spare, None
        return spare

    def wait_ready(self, *names: str, timeout_s: float = 60.0) -> None:
        """Wait until the named nodes have found all their peers."""
        self.wait_until(
            lambda: self.ready >= set(names), timeout_s, f"the endpoints of {', '.join(names)} to be matched"
        )

    def _tell(self, text: str, level: bytes) -> None:
        self.events.append(text)
        self._status = DiagnosticStatus(
            level=level,
            name=f"{self.namespace.strip('/')}/bringup",
            message=text,
            hardware_id=HARDWARE_ID,
            values=[KeyValue(key=f"restarts of {name}", value=str(n)) for name, n in sorted(self.restarts.items())],
        )
        self._told_s = -math.inf
        self._tell_again()

    def _tell_again(self) -> None:
        """Once a second, as nodes do, so that whoever comes later reads it too."""
        if self._status is None or time.monotonic() - self._told_s < 1.0:
            return
        self._told_s = time.monotonic()
        message = DiagnosticArray(status=[self._status])
        message.header.stamp = self.node.get_clock().now().to_msg()
        self._diagnostics.publish(message)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str = "the condition") -> None:
        """Serve the script's own callbacks until ``condition()`` holds.

        Raises
        ------
        NodeError
            When that takes longer than ``timeout_s``, or a node failed meanwhile.
        """
        end = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > end:
                raise NodeError(f"waited {timeout_s:g} s for {what}; it did not come")
            self._executor.spin_once(timeout_sec=0.05)
        self.check()

    def spin_for(self, seconds: float) -> None:
        """Serve the script's own callbacks for some time; raises what a node raised."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.check()
            self._executor.spin_once(timeout_sec=min(left, 0.05))

    def wait_finished(self, *names: str, timeout_s: float) -> None:
        """Wait until the named sources have published all they have."""
        self.wait_until(lambda: self.finished >= set(names), timeout_s, f"the end of {', '.join(names)}")

    def pid(self, name: str) -> int:
        """Process that runs a node."""
        return next(runner.pid for runner in self._runners if runner.name == name)


@contextlib.contextmanager
def bringup(
    config: DrocapConfig,
    nodes: Sequence[str],
    *,
    processes: bool = False,
    namespace: str = DEFAULT_NAMESPACE,
    domain_id: int | None = None,
    timeout_s: float = 60.0,
    respawn: bool = False,
) -> Iterator[Graph]:
    """Run the named nodes while the context lasts.

    Parameters
    ----------
    config : parameters of every component
    nodes : names out of ``nodes.topics.NODES``
    processes : one process each (True), or all in this one, a thread each
    namespace : of the topics that have no leading slash; TF too lies in it, unless it is the default one
    domain_id : DDS domain; None takes a free one and keeps discovery on this machine, so that graphs side by
        side do not hear each other
    timeout_s : for all endpoints to be matched
    respawn : start a node again that dies once the graph runs, after a growing pause, at most ``MOST_RESTARTS``
        times a minute; ``Graph.events`` and ``/diagnostics`` tell it

    Raises
    ------
    InputError
        When a node is unknown or refuses its parameters.
    NodeError
        When the endpoints are not matched in time, or a node fails.
    """
    names = [name for name in NODES if name in nodes]
    unknown = sorted(set(nodes) - set(NODES))
    if unknown or not names:
        raise InputError(f"nodes: expected some of {', '.join(NODES)}; got {', '.join(unknown) or 'none'}")
    with contextlib.ExitStack() as stack:
        if domain_id is None:
            domain_id = stack.enter_context(free_domain())
            stack.enter_context(_environment(ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST"))
        if not processes:
            stack.enter_context(_switch_interval(SWITCH_INTERVAL_S))
        graph = stack.enter_context(watch(namespace, domain_id, names))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="drocap_bringup_")))
        try:
            place = Place(names, namespace, domain_id, folder)

            def make(name: str) -> _Runner:
                chosen = config
                anew = graph.restarts[name] > 0
                if anew and name == "session_recorder":
                    chosen = config.replace(name, if_taken="next")
                if processes:
                    spare = None if hears_a_driver(name, chosen) else graph._take_spare()
                    return NodeProcess(name, chosen, place, spare, anew)
                return _Thread(name, chosen, names, namespace, graph.node.context, anew)

            graph._make = make
            for name in names:
                graph._runners.append(make(name))
            graph.wait_ready(*names, timeout_s=timeout_s)
            graph._start.publish(Empty())
            graph._respawn = respawn
            graph._spare_s = time.monotonic() + SPARE_REST_S
            graph._reserve = partial(Spare, place) if respawn and processes else None
            yield graph
        finally:
            graph._respawn = False
            graph._reserve = None
            if (spare := graph._take_spare()) is not None:
                spare.dismiss()
            for runner in graph._runners:
                runner.stop()
            if spare is not None:
                spare.wait()
        graph._due_s.clear()
        graph.check()


@contextlib.contextmanager
def watch(namespace: str, domain_id: int, names: Sequence[str] = ()) -> Iterator[Graph]:
    """Look at a graph that runs already: a node in its namespace and domain, for the script's own endpoints."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain_id)
    try:
        # The middleware reads it when the first node of the process comes to be.
        with _environment(**{PROFILE_VARIABLE: str(PROFILE_FILE), **os.environ}):
            node = Node("bringup", context=context, namespace=namespace, use_global_arguments=False)
        try:
            yield Graph(node, domain_id, namespace, list(names))
        finally:
            node.destroy_node()
    finally:
        context.try_shutdown()


class _Runner(Protocol):
    """One node, wherever it runs."""

    name: str
    pid: int

    def check(self) -> None:
        """Raise what the node raised."""

    def stop(self) -> None:
        """Ask the node to stop and wait for it."""


class _Thread(_Runner):
    """A node in a thread of this process."""

    def __init__(
        self, name: str, config: DrocapConfig, names: list[str], namespace: str, context: Context, anew: bool
    ) -> None:
        self.name, self.pid = name, os.getpid()
        self._error: BaseException | None = None
        self._stop = threading.Event()
        self._made = threading.Event()

        def make() -> ComponentNode:
            return node_class(name)(
                config.section(name),
                context=context,
                namespace=namespace,
                use_global_arguments=False,
                cli_args=["--ros-args", *remaps(namespace)],
                parameter_overrides=[
                    Parameter("graph_nodes", value=",".join(names)),
                    Parameter("graph_runs", value=anew),
                ],
            )

        # Made in its own thread, so that the threads it starts inherit that one's priority.
        self._thread = threading.Thread(target=self._run, args=(make,), name=name, daemon=True)
        self._thread.start()
        self._made.wait()
        self.check()

    def _run(self, make: Callable[[], ComponentNode]) -> None:
        try:
            try:
                step_back(self.name)
                node = make()
            finally:
                self._made.set()
            spin(node, self._stop)
        except BaseException as error:  # handed to the thread that waits for the graph
            self._error = error

    def check(self) -> None:
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(STOP_TIMEOUT_S)


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A DDS domain id that nobody else on this machine took this way, kept while the context lasts.

    A bound TCP port stands for the id, as in ROS's domain_coordinator; ids up to 100 keep clear of Linux's
    ephemeral ports.
    """
    for domain_id in range(1, 101):
        with socket.socket() as holder:
            try:
                holder.bind(("127.0.0.1", 22_600 + domain_id))
            except OSError:
                continue
            yield domain_id
            return
    raise NodeError("expected a free DDS domain id between 1 and 100, found none; stop other graphs")


@contextlib.contextmanager
def _switch_interval(seconds: float) -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(seconds, before))
    try:
        yield
    finally:
        sys.setswitchinterval(before)


@contextlib.contextmanager
def _environment(**values: str) -> Iterator[None]:
    before: dict[str, Any] = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


__all__ = ["DrocapError", "Graph", "bringup", "free_domain", "node_class", "watch"]
