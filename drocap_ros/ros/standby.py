"""A process in reserve for whichever node of a graph dies.

It opens its place in the middleware under the hidden name ``_spare``, so that all others know it, imports the graph's
nodes, and waits.  Two lines come on its standard input: the names of the nodes that it may have to be, and, when one
has died, ``{"name": ..., "parameters": FILE}``, by which it becomes that one, without the imports that others would
need.  The end of the input ends it.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import queue
import signal
import sys
import threading
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.processes import node_class
from drocap_ros.ros.spin import run_here, stop_on_signal


def main() -> int:
    """Wait for a name, then run that node as a process."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    place = Node("_spare", enable_rosout=False, start_parameter_services=False)
    names = json.loads(sys.stdin.readline() or "[]")
    orders: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=lambda: orders.put(sys.stdin.readline()), daemon=True).start()
    for name in names:
        if orders.empty():
            node_class(name).import_ahead()
    line = orders.get()
    if not line:
        rclpy.try_shutdown()
        return 0
    order = json.loads(line)
    name, arguments = order["name"], ["--ros-args", "--params-file", order["parameters"]]
    show_as([sys.executable, "-m", f"drocap_ros.nodes.{name}", *arguments])

    def make() -> ComponentNode:
        node = node_class(name)(cli_args=arguments)
        place.destroy_node()
        return node

    return run_here(make, name, stop_on_signal())


def show_as(command: list[str]) -> None:
    """Let ``ps`` and ``pgrep`` show another command line, cut to the length of the real one.

    Linux reads it out of the process's own memory, where it is written over.
    """
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()
        begin, end = int(fields[45]), int(fields[46])  # arg_start, arg_end of proc(5)
        text = b"\0".join(map(os.fsencode, command))[: end - begin - 1]
        ctypes.memmove(begin, text.ljust(end - begin, b"\0"), end - begin)


if __name__ == "__main__":
    raise SystemExit(main())
