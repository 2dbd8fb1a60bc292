"""A graph in one thread and in simulated time: the same run on any machine, however busy."""

from __future__ import annotations

import gc
import inspect
import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import cast

from rclpy.clock import ClockType, ROSClock
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from rclpy.time import Time
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from drocap_ros.errors import NodeError
from drocap_ros.recording.session import Message
from drocap_ros.ros.component import ComponentNode
from drocap_ros.ros.conversions import stamp_to_ros
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.topics import NODES

#: First instant of every simulated time, 2026-01-01.
EPOCH_NS = 1_767_225_600 * 10**9
#: Of the clock: half the period of the fastest timer of a node.
STEP_S = 0.01


class Lockstep:
    """Steps the clock of all nodes; each step ends when every timer that was due and every message is done.

    Timers run in the order of the nodes; messages are serialized and delivered in the order of their publication, to
    their subscribers in the order of the nodes.  Neither order depends on the time that a callback takes, so runs are
    equal.  The middleware carries the messages too, and ``/clock``, as soon as a viewer subscribes; before that only
    those that it keeps for late subscribers: a message took 0.5 ms of this thread and more of its own (measured).

    components : with parameter ``use_sim_time``, in the order in which they act
    observer : node of the script, also with ``use_sim_time``; it comes last
    """

    def __init__(self, components: Sequence[ComponentNode], observer: Node) -> None:
        self.components, self.node = list(components), observer
        self.steps = 0
        self._nodes: list[Node] = [*components, observer]
        self._published: deque[tuple[str, bytes, int]] = deque()  # topic, message, number of the message
        self._subscriptions: dict[str, list[tuple[Subscription, bool]]] = {}  # and whether it takes the info
        self._due_ns: dict[Timer, int] = {}
        self._clock = observer.create_publisher(Clock, "/clock", 10)
        self._set_clocks()
        for timer in self._timers():
            self._due_ns[timer] = EPOCH_NS

    @property
    def now_ns(self) -> int:
        """The simulated time."""
        return EPOCH_NS + round(self.steps * STEP_S * 1e9)

    @property
    def now_s(self) -> float:
        """Simulated time since the start."""
        return self.steps * STEP_S

    def start(self) -> None:
        """Make all nodes ready, then activate the sources; messages count from then on."""
        for component in self.components:
            component.become_ready()
        for node in self._nodes:
            for subscription in node.subscriptions:
                entry = subscription, _takes_info(subscription.callback)
                self._subscriptions.setdefault(subscription.topic_name, []).append(entry)
        for component in self.components:
            for _, publisher in component.outputs:
                publish = partial(self._publish, publisher, publisher.publish, itertools.count(1))
                publisher.publish = publish  # type: ignore[method-assign]
        # Without this, the garbage collector visits all modules again and again.
        gc.collect()
        gc.freeze()
        for component in self.components:
            if NODES[component.component].source and isinstance(component, ManagedComponent):
                component.trigger_activate()
        self._deliver()

    def step(self) -> None:
        """Advance the clock by ``STEP_S``, and do all that is then to be done."""
        for timer in self._timers():
            self._due_ns.setdefault(timer, self.now_ns + timer.timer_period_ns)
        self.steps += 1
        self._set_clocks()
        if self._is_heard(self._clock):
            self._clock.publish(Clock(clock=stamp_to_ros(self.now_ns)))
        for timer in self._timers():
            if self._is_due(timer):
                timer.callback()
                self._deliver()

    def run_until(self, condition: Callable[[], bool], limit_s: float, what: str) -> None:
        """Step until ``condition()`` holds.

        Raises NodeError when that takes more than ``limit_s`` of simulated time.
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

    def _timers(self) -> Iterator[Timer]:
        """Timers of the simulated time, in the order of the nodes."""
        for node in self._nodes:
            yield from [timer for timer in node.timers if timer.clock.clock_type == ClockType.ROS_TIME]

    def _is_due(self, timer: Timer) -> bool:
        """Whether a timer has to run now; instants that it missed are left out."""
        now_ns, period_ns = self.now_ns, timer.timer_period_ns
        due_ns = self._due_ns.setdefault(timer, now_ns + period_ns)
        if due_ns > now_ns or timer.is_canceled():
            return False
        self._due_ns[timer] = due_ns + period_ns * max(1, -(-(now_ns - due_ns) // period_ns))
        return True

    def _set_clocks(self) -> None:
        now = Time(nanoseconds=self.now_ns, clock_type=ClockType.ROS_TIME)
        for node in self._nodes:
            cast(ROSClock, node.get_clock()).set_ros_time_override(now)

    def _publish(
        self, publisher: Publisher, publish: Callable[[Message], None], numbers: Iterator[int], message: Message
    ) -> None:
        if self._is_heard(publisher):
            publish(message)
        self._published.append((publisher.topic_name, serialize_message(message), next(numbers)))

    def _is_heard(self, publisher: Publisher) -> bool:
        """Whether others than these nodes subscribe, or may do so late."""
        if publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            return True
        return publisher.get_subscription_count() > len(self._subscriptions.get(publisher.topic_name, ()))

    def _deliver(self) -> None:
        while self._published:
            topic, data, number = self._published.popleft()
            now_ns = self.now_ns
            info = {"publication_sequence_number": number, "source_timestamp": now_ns, "received_timestamp": now_ns}
            for subscription, takes_info in self._subscriptions.get(topic, ()):
                message = data if subscription.raw else deserialize_message(data, subscription.msg_type)
                subscription.callback(*((message, info) if takes_info else (message,)))


def _takes_info(callback: Callable[..., None]) -> bool:
    """Whether a callback takes the message's info too, by rclpy's rule: its number of parameters."""
    try:
        inspect.signature(callback).bind(None)
    except TypeError:
        return True
    return False
