"""Nodes in processes of their own, as the bringup starts them: forks of a server that has imported their modules."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing import resource_tracker
from multiprocessing.forkserver import ensure_running
from pathlib import Path

import rclpy
import yaml

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError, NodeError
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.own_process import LEAN, environment
from drocap_ros.ros.spin import node_main

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_DATA = Path(__file__).parents[1] / "data"


def middleware() -> dict[str, str]:
    """Environment variables by which a process uses our profile of Fast DDS; read when its first node is created."""
    if PROFILE_VARIABLE in os.environ or not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"):
        return {}
    if os.environ.get(RANGE_VARIABLE) == "LOCALHOST":
        # The profile restricts the range; ROS's own restriction would add shared memory.
        return {RANGE_VARIABLE: "SYSTEM_DEFAULT", PROFILE_VARIABLE: str(_DATA / "fastdds_localhost.xml")}
    return {PROFILE_VARIABLE: str(_DATA / "fastdds.xml")}


#: TF has its usual place in this namespace only; another graph has its own, ``NAMESPACE/tf``, since the frames of two
#: drones have the same names.
DEFAULT_NAMESPACE = "/drocap"
#: Above the drain time of a node, and the time that its files may take to close.
STOP_TIMEOUT_S = 20.0
_FORKSERVER = multiprocessing.get_context("forkserver")


class LaunchContext:
    """Place of a graph's processes.

    names : the graph's nodes
    folder : for parameter files and logs
    """

    def __init__(self, names: list[str], namespace: str, domain_id: int, folder: Path) -> None:
        self.names = names
        self.folder = folder
        self.ros_arguments = ["--ros-args", "-r", f"__ns:={namespace}", "--disable-stdout-logs"]
        self.namespace = namespace
        self.environment = {**LEAN, **os.environ, "ROS_DOMAIN_ID": str(domain_id)}
        # The server of this Python process serves all its graphs; it has no thread besides those of LTTng, which its
        # forks do not need.
        _FORKSERVER.set_forkserver_preload([f"drocap_ros.nodes.{name}" for name in names])
        path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
        resource_tracker.ensure_running()  # which unblocks the signal
        with environment({**LEAN, **os.environ, "PYTHONPATH": path}), _blocked(signal.SIGTERM):
            ensure_running()

    def parameter_file(self, name: str, config: DrocapConfig, restarted: bool) -> Path:
        """Write a node's parameters."""
        path = self.folder / f"{name}.yaml"
        section = config.to_parameter_file()[f"/**/{name}"]["ros__parameters"]
        values = {**section, "graph_nodes": ",".join(self.names), "graph_running": restarted}
        path.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}), encoding="utf-8")
        return path


class NodeProcess:
    """A node in a process of its own; ``restarted`` when the graph runs already."""

    def __init__(self, name: str, config: DrocapConfig, context: LaunchContext, restarted: bool = False) -> None:
        self.name = name
        self._log = context.folder / f"{name}.log"
        parameters = str(context.parameter_file(name, config, restarted))
        arguments = [*context.ros_arguments, *remaps(context.namespace), "--params-file", parameters]
        variables = context.environment | middleware()
        # As a daemon it does not survive this process.
        self._process = _FORKSERVER.Process(
            target=_run, name=name, args=(name, arguments, variables, self._log), daemon=True
        )
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid
        self._stopping = False

    def check(self) -> None:
        """Raise the error of the node.

        Raises
        ------
        InputError, NodeError
            With the last message of its log.
        """
        status = self._process.exitcode
        if status is None or (self._stopping and status in (0, -signal.SIGINT, -signal.SIGTERM)):
            return
        lines = self._log.read_text(errors="replace").splitlines() if self._log.exists() else []
        messages = [line for line in lines if line[:1].strip()]  # without the indented lines of a traceback
        last = messages[-1].removeprefix("drocap: ") if messages else "its log is empty"
        if status == InputError.exit_status:
            raise InputError(last)
        raise NodeError(f"node {self.name} ended with status {status}: {last}")

    def stop(self) -> None:
        """Ask the node to stop and wait for it."""
        self._stopping = True
        if self._process.exitcode is not None:
            return
        # The server reaps a node that ends just now before it tells the status.
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGINT)
        self._process.join(STOP_TIMEOUT_S)
        if self._process.exitcode is None:
            self._process.kill()
            self._process.join()


def _run(name: str, arguments: Sequence[str], environment: Mapping[str, str], log: Path) -> None:
    """Body of a node's process."""
    # Out of reach of the terminal's Ctrl-C: the command stops its nodes in order.  The session stays the same, since
    # Linux shares processors out among sessions (autogroups) and niceness has no effect between them.
    os.setpgid(0, 0)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    os.environ.clear()
    os.environ.update(environment)
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(descriptor, 2)
    os.close(descriptor)
    # The name that `top` and `pgrep` show.
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(name[:15])
    sys.argv = [name, *arguments]
    raise SystemExit(node_main(node_class(name)))


@contextlib.contextmanager
def _blocked(number: signal.Signals) -> Iterator[None]:
    """Processes that start meanwhile ignore a signal.

    A group that receives SIGTERM (``timeout``, systemd) would lose the server before the command has stopped its nodes.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def remaps(namespace: str) -> list[str]:
    """ROS arguments that keep one graph's TF from another's."""
    return [] if namespace == DEFAULT_NAMESPACE else ["--ros-args", "-r", f"/tf:={namespace.rstrip('/')}/tf"]


def node_class(name: str) -> type[ComponentNode]:
    """Class of a node by its name; only its module is imported."""
    module = importlib.import_module(f"drocap_ros.nodes.{name}")
    found: type[ComponentNode] = next(
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, ComponentNode) and value.__dict__.get("component") == name
    )
    return found
