"""Start any subset of the nodes from one configuration, without ``ros2 launch``.

    if __name__ == "__main__":  # with processes=True and with lockstep, as with every use of multiprocessing
        with bringup(config, ["image_ingest", "pose_estimator", "session_recorder"]) as graph:
            graph.wait_finished("image_ingest", timeout_s=60)

On entry every publisher and subscription among the chosen nodes is matched, then the sources are activated: nothing is
lost at the start.  On exit the nodes stop from the sources downwards, each processing the messages that have arrived,
and the error of a node is raised here.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError, NodeError
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.parameters import Values
from drocap_ros.reconstruction.common.engine import blas_threads
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.graph import Graph, Runner
from drocap_ros.ros.lockstep import Lockstep
from drocap_ros.ros.own_process import environment
from drocap_ros.ros.processes import (
    DEFAULT_NAMESPACE,
    RANGE_VARIABLE,
    STOP_TIMEOUT_S,
    LaunchContext,
    NodeProcess,
    middleware,
    node_class,
    remaps,
)
from drocap_ros.ros.rclpy_internals import node_executor
from drocap_ros.ros.spin import spin
from drocap_ros.ros.topics import NODES


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

    config : parameters of every component
    nodes : names out of ``ros.topics.NODES``
    processes : one process each (True), or all in this one, a thread each: for small machines, tests and scripts; the
        nodes then share Python's lock
    namespace : of the topics that have no leading slash; TF too lies in it, unless it is the default one
    domain_id : DDS domain; None takes a free one and keeps discovery on this machine, so that graphs side by
        side do not receive each other's messages
    timeout_s : for all endpoints to be matched
    respawn : restart a node that dies once the graph runs, after a growing pause, at most ``graph.MOST_RESTARTS``
        times a minute; ``Graph.events`` and ``/diagnostics`` report it

    Raises NodeError when the endpoints are not matched in time, or a node fails.
    """
    names = [name for name in NODES if name in nodes]
    unknown = sorted(set(nodes) - set(NODES))
    if unknown or not names:
        raise InputError(f"nodes: expected some of {', '.join(NODES)}; got {', '.join(unknown) or 'none'}")
    with contextlib.ExitStack() as stack:
        if domain_id is None:
            domain_id = stack.enter_context(free_domain())
            stack.enter_context(environment({RANGE_VARIABLE: "LOCALHOST"}))
        graph = stack.enter_context(watch(namespace, domain_id, names))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="drocap_bringup_")))
        launch = LaunchContext(names, namespace, domain_id, folder) if processes else None

        def start(name: str, restarted: bool) -> Runner:
            chosen = config
            if restarted and name == "session_recorder":
                chosen = config.replace(name, if_taken="next")
            if launch is not None:
                return NodeProcess(name, chosen, launch, restarted)
            return _NodeThread(name, chosen, names, namespace, graph.node.context, restarted)

        try:
            graph.start(start)
            graph.wait_ready(*names, timeout_s=timeout_s)
            graph.activate(*(name for name in names if NODES[name].source), timeout_s=timeout_s)
            graph.respawn = respawn
            yield graph
        finally:
            graph.stop()
        graph.check()


@contextlib.contextmanager
def watch(namespace: str, domain_id: int, names: Sequence[str] = (), *, lean: bool = False) -> Iterator[Graph]:
    """Observe a running graph: a node in its namespace and domain, for the script's own endpoints.

    lean : messages cost a fourth, by the executor of nodes; for those who hear every topic
    """
    context = Context()
    with environment(middleware()):
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = Node("bringup", context=context, namespace=namespace, use_global_arguments=False)
    try:
        yield Graph(node, domain_id, namespace, list(names), node_executor(context) if lean else None)
    finally:
        node.destroy_node()
        context.try_shutdown()


@contextlib.contextmanager
def lockstep(
    config: DrocapConfig,
    nodes: Sequence[str],
    *,
    transports: Mapping[str, Transport] | None = None,
) -> Iterator[Lockstep]:
    """Run the named nodes in this thread, in simulated time and in the default namespace, while the context lasts.

    The caller adds its own endpoints to ``Lockstep.node`` and then calls ``Lockstep.start``.

    config, nodes : as of :func:`bringup`; the DDS domain is a free one
    transports : simulated ends of MAVLink links, by the nodes that own them

    Raises NodeError when a node refuses its parameters or fails.
    """
    names = [name for name in NODES if name in nodes]
    overrides = [Parameter("use_sim_time", value=True), Parameter("graph_nodes", value=",".join(names))]
    with contextlib.ExitStack() as stack:
        domain_id = stack.enter_context(free_domain())
        stack.enter_context(environment({RANGE_VARIABLE: "LOCALHOST"}))
        stack.enter_context(environment(middleware()))
        # More threads would make the last bits depend on the machine.
        stack.enter_context(blas_threads(1))
        context = Context()
        rclpy.init(args=["--ros-args", "--disable-stdout-logs"], context=context, domain_id=domain_id)
        stack.callback(context.try_shutdown)
        place: Values = {"context": context, "namespace": DEFAULT_NAMESPACE, "use_global_arguments": False}
        components: list[ComponentNode] = []
        stack.callback(_close, components)
        for name in names:
            link = {"transport": transports[name]} if transports and name in transports else {}
            components.append(node_class(name)(config.section(name), **link, **place, parameter_overrides=overrides))
        for component in components:
            component.beside.update((other.component, other) for other in components)
        observer = Node("bringup", **place, parameter_overrides=overrides[:1])
        stack.callback(observer.destroy_node)
        graph = Lockstep(components, observer)
        yield graph
        graph.stop()


def _close(components: list[ComponentNode]) -> None:
    """Close nodes, from the sources downwards."""
    with contextlib.ExitStack() as stack:
        for component in reversed(components):
            stack.callback(component.destroy_node)
            stack.callback(component.close)


class _NodeThread:
    """A node in a thread of this process."""

    def __init__(
        self, name: str, config: DrocapConfig, names: list[str], namespace: str, context: Context, restarted: bool
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
                cli_args=remaps(namespace),
                parameter_overrides=[
                    Parameter("graph_nodes", value=",".join(names)),
                    Parameter("graph_running", value=restarted),
                ],
            )

        self._thread = threading.Thread(target=self._run, args=(make, context), name=name, daemon=True)
        self._thread.start()
        self._made.wait()
        self.check()

    def _run(self, make: Callable[[], ComponentNode], context: Context) -> None:
        try:
            node = make()
            self._made.set()
            spin(node, node_executor(context), self._stop)
        except BaseException as error:  # noqa: BLE001 -- raised in the thread that waits for the graph
            self._error = error
        finally:
            self._made.set()

    def check(self) -> None:
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(STOP_TIMEOUT_S)


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A DDS domain id that no other caller on this machine holds, held while the context lasts.

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


__all__ = ["Graph", "Lockstep", "bringup", "free_domain", "lockstep", "node_class", "watch"]
