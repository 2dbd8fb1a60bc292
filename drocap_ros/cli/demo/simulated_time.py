"""The demo's flight in simulated time: the same seed gives the same flight on any machine."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from drocap_ros.cli.demo.desk import NODES, Desk, longest_s
from drocap_ros.cli.demo.operator import REST_S, Operator
from drocap_ros.cli.graph.live import import_bringup
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

if TYPE_CHECKING:
    from drocap_ros.config import DrocapConfig


def fly_in_simulated_time(
    config: DrocapConfig, operator: Operator, say: Callable[[float, str], None], interrupted: threading.Event
) -> float:
    """Fly until the operator is done; returns the simulated time that passed, s.

    ``say`` : prints a remark at a simulated time, s

    Raises
    ------
    KeyboardInterrupt
        Soon after ``interrupted`` is set.
    DrocapError
        When a node refuses its parameters or fails, or the flight takes far longer than it can.
    """
    down, up = (Channel(lambda: graph.now_s, config.flight_simulator.seed + i) for i in (1, 2))
    transports = {"mavlink_bridge": LoopbackTransport(down, up), "flight_simulator": LoopbackTransport(up, down)}
    with _errors_only(), import_bringup().lockstep(config, NODES, transports=transports) as graph:
        desk = Desk(graph.node, operator, lambda text: say(graph.now_s, text), lambda: graph.now_s)
        requests = next(node for node in graph.components if node.component == "mavlink_bridge").requests

        def over() -> bool:
            # A command and its answer arrive in the step in which they were sent.
            graph.wait_for(lambda: requests.fetch() == len(desk.commands), what="a command")
            while desk.answered() < requests.answered:
                graph.serve()
            return operator.over or interrupted.is_set()

        graph.start()
        graph.run_until(over, longest_s(operator), "the end of the flight")
        if interrupted.is_set():
            raise KeyboardInterrupt
        if operator.failure:
            graph.run_for(REST_S)  # for the hold after the operator's last command
        return graph.now_s


@contextmanager
def _errors_only() -> Iterator[None]:
    """The nodes report on /diagnostics; with a process each, their logs are not shown either."""
    logger = logging.getLogger("drocap_ros")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)
