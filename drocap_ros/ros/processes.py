"""Nodes in processes of their own, as the bringup starts them, and a spare one for a node that dies."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError, NodeError
from drocap_ros.ros import fastdds as middleware
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.spin import PARENT
from drocap_ros.ros.topics import TOPIC_SOURCE

#: In this namespace TF is where everybody looks for it; in another each graph has its own, ``NAMESPACE/tf``, as the
#: frames of two drones bear the same names.
DEFAULT_NAMESPACE = "/drocap"

#: Above the drain time of a node, and the time that its files may take to close.
STOP_TIMEOUT_S = 20.0

#: The matrices of a node are small: more BLAS threads cost more than they bring, the more so in six processes.  The
#: middleware's many threads would each keep an arena of their own, in which memory goes to pieces over hours.
_LEAN = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    # What was needed once is kept: given back and asked for again, memory frays, and each new page costs time.
    "MALLOC_TRIM_THRESHOLD_": str(1 << 28),
    "MALLOC_MMAP_THRESHOLD_": str(1 << 25),
}
#: Ctrl-C is for the command, which stops its nodes in order.  They stay in its session: where Linux shares processors
#: out among sessions (autogroups), niceness means nothing between these, and what runs last of all in one keeps
#: another's node waiting.
_OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"preexec_fn": os.setpgrp}


class Place:
    """Where the processes of a graph run.

    names : the graph's nodes
    folder : for parameter files and logs
    """

    def __init__(self, names: list[str], namespace: str, domain_id: int, folder: Path) -> None:
        self.names = names
        self.folder = folder
        self.ros_arguments = ["--ros-args", "-r", f"__ns:={namespace}", *remaps(namespace), "--disable-stdout-logs"]
        self._environment = {**_LEAN, **os.environ, "ROS_DOMAIN_ID": str(domain_id), PARENT: str(os.getpid())}

    def start(
        self, module: str, arguments: Sequence[str], log: Path, stdin: int | None = None, shared_memory: bool = False
    ) -> subprocess.Popen:
        """Run a module of ``drocap_ros.nodes``, out of reach of the terminal's Ctrl-C."""
        command = [sys.executable, "-m", f"drocap_ros.nodes.{module}", *self.ros_arguments, *arguments]
        environment = self._environment | middleware.settings(self.folder, shared_memory)
        with log.open("ab") as stderr:
            return subprocess.Popen(command, env=environment, stdin=stdin, stderr=stderr, text=True, **_OWN_GROUP)

    def parameter_file(self, name: str, config: DrocapConfig, anew: bool) -> Path:
        """Write a node's parameters; one that starts anew finds the graph running and waits for no sign to begin."""
        path = self.folder / f"{name}.yaml"
        section = config.to_parameter_file()[f"/**/{name}"]["ros__parameters"]
        values = {**section, "graph_nodes": ",".join(self.names), "graph_runs": anew}
        path.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}), encoding="utf-8")
        return path


class Spare:
    """A process that has all but the node's name: modules imported, and known to the graph's other processes.

    A node that dies is started again in it within a second, on a machine where a new process takes three to be there
    and to be found.
    """

    _count = 0

    def __init__(self, place: Place) -> None:
        Spare._count += 1
        self.log = place.folder / f"spare_{Spare._count}.log"
        self.process = place.start("spare", [], self.log, subprocess.PIPE)
        self._say(place.names)

    def become(self, name: str, parameters: Path) -> bool:
        """Run that node from now on; False when the process is no more."""
        there = self._say({"name": name, "parameters": str(parameters)})
        self._hang_up()
        return there and self.process.poll() is None

    def _say(self, what: object) -> bool:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(what) + "\n")
            self.process.stdin.flush()
        except (OSError, ValueError):  # dead, or hung up on
            return False
        return True

    def _hang_up(self) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()

    def dismiss(self) -> None:
        """Let it end without use, as soon as it looks."""
        self._hang_up()

    def wait(self) -> None:
        """Wait until it has ended."""
        try:
            self.process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class NodeProcess:
    """A node in a process of its own; ``anew`` when the graph runs already."""

    def __init__(
        self, name: str, config: DrocapConfig, place: Place, spare: Spare | None = None, anew: bool = False
    ) -> None:
        self.name = name
        parameters = place.parameter_file(name, config, anew)
        if spare is not None and spare.become(name, parameters):
            self._process, self._log = spare.process, spare.log
        else:
            self._log = place.folder / f"{name}.log"
            arguments = ["--params-file", str(parameters)]
            self._process = place.start(name, arguments, self._log, shared_memory=hears_a_driver(name, config))
        self.pid = self._process.pid
        self._stopping = False

    def check(self) -> None:
        """Raise what the node raised.

        Raises
        ------
        InputError, NodeError
            With the last line that it said.
        """
        status = self._process.poll()
        if status is None or (self._stopping and status in (0, -signal.SIGINT)):
            return
        lines = self._log.read_text(errors="replace").strip().splitlines() or ["it said nothing"]
        words = lines[-1].removeprefix("drocap: ")
        if status == InputError.exit_status:
            raise InputError(words)
        raise NodeError(f"node {self.name} ended with status {status}: {words}")

    def stop(self) -> None:
        """Ask the node to stop and wait for it."""
        if self._process.poll() is not None:
            return
        self._stopping = True
        self._process.send_signal(signal.SIGINT)
        try:
            self._process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def hears_a_driver(name: str, config: DrocapConfig) -> bool:
    """Whether the node takes its pictures from a topic, as raw ones perhaps; no process in reserve can do that."""
    return name == "image_ingest" and config.image_ingest.source.startswith(TOPIC_SOURCE)


def remaps(namespace: str) -> list[str]:
    """ROS arguments that keep one graph's TF from another's."""
    return [] if namespace == DEFAULT_NAMESPACE else ["-r", f"/tf:={namespace.rstrip('/')}/tf"]


def node_class(name: str) -> type[ComponentNode]:
    """Class of a node by its name; only the chosen ones are imported."""
    module = importlib.import_module(f"drocap_ros.nodes.{name}")
    found: type[ComponentNode] = next(
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, ComponentNode) and value.__dict__.get("component") == name
    )
    return found
