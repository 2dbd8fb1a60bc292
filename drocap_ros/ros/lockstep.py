"""A graph in one thread and in simulated time: the same run on any machine, however busy."""

from __future__ import annotations

import gc
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rclpy.clock import ClockType
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from drocap_ros.errors import NodeError
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.conversions import stamp_to_ros
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.topics import NODES

#: First instant of every simulated time, 2026-01-01.
EPOCH_NS = 1_767_225_600 * 10**9
STEP_S = 0.01
#: Longest wait for bytes that the middleware carries within this process.
_ARRIVAL_S = 20.0
_SERVE_EVERY = 10  # steps


class Lockstep:
    """Steps the clock of all nodes; each step ends when every timer that was due and every message is done.

    Timers run in the order of the nodes; messages pass the middleware and are delivered in the order of their
    publication, to their subscribers in the order of the nodes.  Neither order depends on the time that a callback
    takes, so runs are equal.  ``/clock`` is published for viewers.

    Parameters
    ----------
    components : with parameter ``use_sim_time``, in the order in which they act
    observer : node of the script, also with ``use_sim_time``; it comes last
    """

    def __init__(self, components: Sequence[ComponentNode], observer: Node) -> None:
        self.components, self.node = list(components), observer
        self.steps = 0
        self._nodes: list[Node] = [*components, observer]
        self._published: deque[str] = deque()
        self._subscribers: dict[str, list[Subscription]] = {}
        self._clock = observer.create_publisher(Clock, "/clock", 10)
        self._set_clocks()

    @property
    def now_ns(self) -> int:
        """The simulated time."""
        return EPOCH_NS + round(self.steps * STEP_S * 1e9)

    @property
    def now_s(self) -> float:
        """Simulated time since the start."""
        return self.steps * STEP_S

    def start(self, timeout_s: float = 60.0) -> None:
        """Match all endpoints, then activate the sources.

        Raises
        ------
        NodeError
            When the endpoints are not matched in time.
        """
        self.wait_for(self._all_ready, timeout_s, "the endpoints to be matched")
        for node in self._nodes:
            for subscription in node.subscriptions:
                self._subscribers.setdefault(subscription.topic_name, []).append(subscription)
        # What the nodes published before the start depends on the machine: nobody receives it.
        for component in self.components:
            component.flush()
        for subscription in [s for found in self._subscribers.values() for s in found]:
            while _taken(subscription) is not None:
                pass
        for component in self.components:
            for name, publisher in component.outputs:
                topic = component.resolve_topic_name(name)
                publisher.publish = partial(self._publish, topic, publisher.publish)  # type: ignore[method-assign]
        # Without this, the garbage collector visits all modules again and again.
        gc.collect()
        gc.freeze()
        for component in self.components:
            if NODES[component.component].source and isinstance(component, ManagedComponent):
                component.trigger_activate()
        self._deliver()

    def step(self) -> None:
        """Advance the clock by ``STEP_S``, and do all that is then to be done."""
        self.steps += 1
        self._set_clocks()
        self._clock.publish(Clock(clock=stamp_to_ros(self.now_ns)))
        for node in self._nodes:
            for timer in list(node.timers):
                if timer.clock.clock_type == ClockType.ROS_TIME and timer.is_ready():
                    timer.handle.call_timer()
                    timer.callback()
                    self._deliver()
        if self.steps % _SERVE_EVERY == 0:
            self.serve()

    def run_until(self, condition: Callable[[], bool], limit_s: float, what: str) -> None:
        """Step until ``condition()`` holds.

        Raises
        ------
        NodeError
            When that takes more than ``limit_s`` of simulated time.
        """
        end = self.steps + round(limit_s / STEP_S)
        while not condition():
            if self.steps >= end:
                raise NodeError(f"waited {limit_s:g} s of simulated time for {what}; it did not come")
            self.step()

    def run_for(self, seconds: float) -> None:
        """Step for some simulated time."""
        for _ in range(round(seconds / STEP_S)):
            self.step()

    def stop(self) -> None:
        """Let the nodes end their work, from the sources downwards."""
        for component in self.components:
            component.on_stop()
            self._deliver()

    def serve(self) -> None:
        """Answer the requests to services, such as for parameters, and take the answers that have arrived."""
        services: list[Any] = [service for node in self._nodes for service in node.services]
        for service in services:
            request, header = service.handle.service_take_request(service.srv_type.Request)
            if header is not None:
                service.send_response(service.callback(request, service.srv_type.Response()), header)
        clients: list[Any] = [client for node in self._nodes for client in node.clients]
        for client in clients:
            header, response = client.handle.take_response(client.srv_type.Response)
            if header is not None:
                client.get_pending_request(header.request_id.sequence_number).set_result(response)

    def wait_for(self, arrived: Callable[[], bool], timeout_s: float = _ARRIVAL_S, what: str = "a message") -> None:
        """Wait for the middleware; the simulated time stands still.

        Raises
        ------
        NodeError
            When that takes too long.
        """
        end_s = time.monotonic() + timeout_s
        while not arrived():
            if time.monotonic() > end_s:
                raise NodeError(f"waited {timeout_s:g} s for {what}; it did not come")
            time.sleep(0.0005)

    def _all_ready(self) -> bool:
        for component in self.components:
            if not component.ready:
                component.match()
        return all(component.ready for component in self.components)

    def _set_clocks(self) -> None:
        now = Time(nanoseconds=self.now_ns, clock_type=ClockType.ROS_TIME)
        for node in self._nodes:
            node.get_clock().set_ros_time_override(now)  # type: ignore[attr-defined]

    def _publish(self, topic: str, publish: Callable[[Any], None], message: Any) -> None:
        publish(message)
        self._published.append(topic)

    def _deliver(self) -> None:
        while self._published:
            topic = self._published.popleft()
            for subscription in self._subscribers.get(topic, ()):
                taken: list[Any] = []

                def arrived(subscription: Subscription = subscription, taken: list[Any] = taken) -> bool:
                    taken[:] = [_taken(subscription)]
                    return taken[0] is not None

                self.wait_for(arrived, what=f"a message on {topic}")
                alone = subscription._callback_type is Subscription.CallbackType.MessageOnly
                subscription.callback(*(taken[0][:1] if alone else taken[0]))


def _taken(subscription: Subscription) -> tuple[Any, Any] | None:
    """The next message with its info, or None."""
    found: tuple[Any, Any] | None = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    return found
