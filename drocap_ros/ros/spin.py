"""Spin one node: the body of every node's ``main`` and of the bringup's threads."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from drocap_ros.errors import DrocapError
from drocap_ros.ros.component import ComponentNode

#: After the order to stop, messages that have arrived are still worked off, for this long at most.
DRAIN_S = 5.0

#: How far a node steps back (Unix niceness) behind those that most depend on time: the bridge, whose control loop a
#: vehicle hangs on, pose estimator and initializer.  With one core busy for the networks alone, whatever else breaks in
#: on them costs pictures.
NICENESS = {
    "image_ingest": 5,
    "session_recorder": 10,
    "bundle_adjuster": 15,
    "visualizer": 15,
}
#: From here on a node does not even break in on others when something has come for it.
_BACKGROUND = 10
#: From here on it takes only what the others leave, in a process of its own.
_LAST = 15

#: Names the process that started this node; when that one is gone, the node stops.
PARENT = "DROCAP_PARENT_PID"


def spin(node: ComponentNode, stop: threading.Event, when_settled: Callable[[], None] | None = None) -> None:
    """Run the node's callbacks until ``stop``, then work off what has arrived, and close the node.

    ``when_settled`` is called once, as soon as nobody waits for the node any more.  Whatever a callback raises comes
    out of here.
    """
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    # What stands now stays: without this, the collector walks through all modules again and again.
    gc.collect()
    gc.freeze()
    parent = int(os.environ.get(PARENT, "0"))
    try:
        while not stop.is_set() and node.context.ok():
            if node.spin_pause_s == 0:
                executor.spin_once(timeout_sec=0.1)
            elif not _turn(executor, node, 0.0):
                stop.wait(node.spin_pause_s)
            if when_settled is not None and node.settled:
                when_settled()
                when_settled = None
            if parent not in (0, os.getppid(), os.getpid()):
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


def step_back(component: str, own_process: bool = False) -> None:
    """Give the calling thread, and those that it will start, the niceness of a node.

    What comes last of all runs only where a processor has nothing else to do (SCHED_IDLE): whoever wakes takes its
    place at once, which niceness alone does not give.  In a process of its own only: a thread that holds Python's lock
    and is not let run holds up all others of its process.
    """
    niceness = NICENESS.get(component, 0)
    # Not every system has priorities of threads, and one without them runs as well, if not as evenly.
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), niceness)
        if niceness >= _BACKGROUND:
            idle = own_process and niceness >= _LAST
            os.sched_setscheduler(0, os.SCHED_IDLE if idle else os.SCHED_BATCH, os.sched_param(0))


def step_process_back(component: str) -> None:
    """The same for a process, with all the threads that it has by now."""
    niceness = NICENESS.get(component, 0)
    if niceness == 0:
        return
    with contextlib.suppress(OSError, AttributeError):
        for thread in map(int, os.listdir("/proc/self/task")):
            os.setpriority(os.PRIO_PROCESS, thread, niceness)
            if niceness >= _BACKGROUND:
                os.sched_setscheduler(thread, os.SCHED_BATCH, os.sched_param(0))
    step_back(component, own_process=True)


def _drain(executor: SingleThreadedExecutor, node: ComponentNode) -> None:
    clock = node.get_clock()
    end = clock.now().nanoseconds + int(DRAIN_S * 1e9)
    while clock.now().nanoseconds < end and node.context.ok() and _turn(executor, node, 0.05):
        pass


def _turn(executor: SingleThreadedExecutor, node: ComponentNode, timeout_s: float) -> bool:
    """One callback, if any comes within the time; returns whether a message was taken."""
    before = node.callbacks_done
    executor.spin_once(timeout_sec=timeout_s)
    return node.callbacks_done != before


def node_main(make: Callable[[], ComponentNode]) -> int:
    """Run one node as a process until SIGINT or SIGTERM; returns the exit status."""
    stop = stop_on_signal()
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    return run_here(make, getattr(make, "component", ""), stop)


def stop_on_signal() -> threading.Event:
    """What SIGINT and SIGTERM set from now on."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def run_here(make: Callable[[], ComponentNode], component: str, stop: threading.Event) -> int:
    """:func:`node_main` where rclpy is initialized already."""
    try:
        # It steps back only then: a node that was started again is waited for.
        spin(make(), stop, lambda: step_process_back(component))
    except DrocapError as error:
        print(f"drocap: {error}", file=sys.stderr)
        return error.exit_status
    finally:
        rclpy.try_shutdown()
    return 0
