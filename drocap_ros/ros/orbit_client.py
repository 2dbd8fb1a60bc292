"""Client of the service ``orbit/command``, on a node of a graph or on a node of its own."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from drocap_ros.msg import OrbitStatus
from drocap_ros.ros.topics import RESULT_QOS
from drocap_ros.srv import OrbitCommand


class OrbitClient:
    """Sends commands to ``mavlink_bridge``.

    statuses : messages of ``orbit/status`` since :meth:`subscribe`
    """

    def __init__(self, node: Any) -> None:
        self.statuses: list[Any] = []
        self._node = node
        self._client = node.create_client(OrbitCommand, "orbit/command", qos_profile=RESULT_QOS)

    @property
    def is_ready(self) -> bool:
        """Whether a bridge serves the commands."""
        return bool(self._client.service_is_ready())

    def subscribe(self) -> None:
        """Collect the bridge's status."""
        self._node.create_subscription(OrbitStatus, "orbit/status", self.statuses.append, RESULT_QOS)

    def send(
        self, command: int, radius_m: float = math.nan, height_m: float = math.nan, speed_deg_s: float = math.nan
    ) -> Any:
        """Send a command, stamped now; returns the future of its answer (``accepted``, ``condition``, ``words``)."""
        stamp = self._node.get_clock().now().to_msg()
        return self._client.call_async(
            OrbitCommand.Request(
                stamp=stamp, command=command, radius_m=radius_m, height_m=height_m, angular_speed_deg_s=speed_deg_s
            )
        )


@contextlib.contextmanager
def orbit_client(
    namespace: str, domain_id: int, timeout_s: float
) -> Iterator[tuple[OrbitClient, Callable[[Callable[[], bool]], bool]]]:
    """A client on a node of its own, and a function that waits for a condition until ``timeout_s`` from now."""
    context = Context()
    rclpy.init(args=[], context=context, domain_id=domain_id)
    node = rclpy.create_node("orbit_operator", context=context, namespace=namespace)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    end = time.monotonic() + timeout_s

    def wait(done: Callable[[], bool]) -> bool:
        while not done() and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        return done()

    try:
        yield OrbitClient(node), wait
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
