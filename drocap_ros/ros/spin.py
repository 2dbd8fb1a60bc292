"""Spin one node: the body of every node's ``main`` and of the bringup's threads."""

from __future__ import annotations

import contextlib
import gc
import inspect
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from drocap_ros.errors import DrocapError, InputError
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.parameters import parameter_help
from drocap_ros.ros.rclpy_internals import node_executor
from drocap_ros.ros.topics import NODES

#: After the order to stop, messages that have arrived are still processed, for this long at most.
DRAIN_S = 5.0
#: A node has processed all messages when none came for this long ...
_QUIET_S = 0.05
#: ... and for so many turns of the executor: on a busy machine a single timer's callback may take longer.
_QUIET_TURNS = 5
#: Interval at which a node asks whether the processes that started it live: asking costs more than many a message.
_ORPHAN_S = 0.1
#: At or above this niceness nodes use SCHED_BATCH: a message for them does not preempt other nodes.
_BATCH = 10


def spin(
    node: ComponentNode, executor: Executor, stop: threading.Event, on_ready: Callable[[], None] | None = None
) -> None:
    """Run the node's callbacks until ``stop``, then process the messages that have arrived, and close the node.

    ``on_ready`` is called once, when the node is ready.  An error of a callback or of the node's threads is raised.
    """
    executor.add_node(node)
    # Without this, the garbage collector visits all modules again and again.
    gc.collect()
    gc.freeze()
    parent, server, asked_s = multiprocessing.parent_process(), os.getppid(), time.monotonic()
    try:
        while not stop.is_set() and node.context.ok():
            executor.spin_once(timeout_sec=0.1)
            if node.failure is not None:
                raise node.failure
            if on_ready is not None and node.ready:
                on_ready()
                on_ready = None
            # Without the bringup that started it a node stops, and without the server that forked it too: the bringup
            # then learns of no end of the node and starts another.
            if parent is not None and time.monotonic() - asked_s > _ORPHAN_S:
                asked_s = time.monotonic()
                if not (parent.is_alive() and os.getppid() == server):
                    stop.set()
        node.on_stop()
        _drain(executor, node)
        node.flush()
    except ExternalShutdownException:
        pass
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()


def _drain(executor: Executor, node: ComponentNode) -> None:
    begin_s = quiet_s = time.monotonic()
    turns = 0
    while node.context.ok() and (now_s := time.monotonic()) - begin_s < DRAIN_S:
        if turns >= _QUIET_TURNS and now_s - quiet_s >= _QUIET_S:
            return
        before = node.callbacks_done
        executor.spin_once(timeout_sec=_QUIET_S / _QUIET_TURNS)
        turns += 1
        if node.callbacks_done != before:
            turns, quiet_s = 0, time.monotonic()


def lower_priority(niceness: int) -> None:
    """Give all threads of this process, and those that they start, a Unix niceness; from 10 on SCHED_BATCH too."""
    if niceness == 0:
        return
    seen: set[str] = set()
    # A thread may start or end meanwhile; not every system has priorities of threads.
    while new := {path.name for path in Path("/proc/self/task").glob("*")} - seen:
        seen |= new
        for thread in map(int, new):
            with contextlib.suppress(OSError, AttributeError):
                os.setpriority(os.PRIO_PROCESS, thread, niceness)
                if niceness >= _BATCH:
                    os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))


def node_main(node_class: type[ComponentNode]) -> int:
    """Run one node as a process until SIGINT or SIGTERM; returns the exit status.

    ``--help`` prints the node's description and parameters and ends.
    """
    words = remove_ros_args(sys.argv)[1:]
    if "-h" in words or "--help" in words:
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `--help | head`
        print(_help(node_class))
        return 0
    if words:
        print(f"drocap: {words[0]}: expected ROS arguments after --ros-args; see --help", file=sys.stderr)
        return InputError.exit_status
    stop = threading.Event()
    _stop_on_signal(stop)
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    executor = node_executor()
    # Again: the executor has replaced the handlers by its own, which shut the context down before the node has stopped.
    _stop_on_signal(stop)
    try:
        # A restarted node keeps the usual priority until it is ready.
        node = node_class()
        spin(node, executor, stop, partial(lower_priority, NODES[node.component].niceness))
    except DrocapError as error:
        print(f"drocap: {error}", file=sys.stderr)
        return error.exit_status
    finally:
        rclpy.try_shutdown()
    return 0


def _help(node_class: type[ComponentNode]) -> str:
    """Description of a node, its parameters, and how to give them."""
    text = inspect.getdoc(inspect.getmodule(node_class)) or ""
    return (
        f"{text.strip()}\n\nusage: python -m drocap_ros.nodes {node_class.component}"
        " [--ros-args -p NAME:=VALUE ... | --params-file FILE]\n\n"
        f"parameters (default):\n{parameter_help(node_class.component)}"
    )


def _stop_on_signal(stop: threading.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
