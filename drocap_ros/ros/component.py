"""What every node shares: parameters, diagnostics, and the handshake with the bringup."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import Empty, String

from drocap_ros.config import section_types
from drocap_ros.errors import InputError
from drocap_ros.parameters import Parameters
from drocap_ros.ros.latency import LAST_REFUSED, LATENCY, LATENCY_P95, RATE, Latency
from drocap_ros.ros.parameters import declare_parameters
from drocap_ros.ros.stamps import StampGate
from drocap_ros.ros.topics import FROM_OUTSIDE, GRAPH_QOS, RESULT_QOS, TOPICS, publishers_of, subscribers_of

#: By which the statuses of this package's nodes are known on ``/diagnostics``.
HARDWARE_ID = "drocap_ros"
#: A node that was started again is waited for until it has its first results, this long after it has found its peers.
SETTLING_S = 2.0
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class _Polled(CallbackGroup):
    """Subscriptions for which the executor does not wake: the node looks after them when it is time."""

    def can_execute(self, entity: Any) -> bool:
        return False

    def beginning_execution(self, entity: Any) -> bool:
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing begins."""


class Gaps:
    """Counts what the one publisher of a topic sent and a subscriber never saw."""

    def __init__(self) -> None:
        self._last = 0

    def before(self, info: dict[str, Any]) -> int:
        """How many were left out before the message of this info; a publisher that began anew left out none."""
        number = info["publication_sequence_number"] or 0
        last, self._last = self._last, number
        return number - 1 - last if 0 < last < number - 1 else 0


class ComponentNode(Node):
    """A node of the capture graph.

    Topics (beside its own, see ``topics.NODES``): publishes ``/diagnostics`` once a second; with parameter
    ``graph_nodes`` set, publishes its name on ``graph/ready`` as soon as all its peers are matched and
    begins to produce only at ``graph/start``, or at once with ``graph_runs``; ``graph/finished`` when its
    source has ended.

    Parameters
    ----------
    config : the component's parameters; ROS parameter overrides go before it
    node_kwargs : passed on to :class:`rclpy.node.Node` (context, namespace, parameter_overrides, ...)
    """

    component: ClassVar[str]
    #: Pause between two turns of the executor, for nodes on whose answers nobody waits.
    spin_pause_s: ClassVar[float] = 0.0

    def __init__(self, config: Parameters | None = None, **node_kwargs: Any) -> None:
        node_kwargs.setdefault("namespace", "/drocap")
        super().__init__(self.component, **node_kwargs)
        peers = self.declare_parameter("graph_nodes", "").value
        self._graph_runs = bool(self.declare_parameter("graph_runs", False).value)
        #: All nodes of the graph, where a bringup has said so.
        self.peers: list[str] = [name for name in peers.split(",") if name]
        self.config: Any = declare_parameters(self, config or section_types()[self.component]())
        self.counters: Counter[str] = Counter()
        self._counting = threading.Lock()
        self.details: dict[str, str] = {}
        self._latency = Latency()
        #: Whether all its peers are matched, if it waits for any.
        self.ready = False
        self._settled_s = math.inf
        self.started = False
        #: Whether messages are taken; only a managed node is ever not active.
        self.active = True
        self.callbacks_done = 0
        self._level = OK
        self._text = "running"
        self._outputs: list[tuple[str, Publisher]] = []
        self._inputs: list[tuple[str, Subscription]] = []
        #: Topic -> how many nodes of this process get its contents without DDS.
        self.handed_over: dict[str, Callable[[], int]] = {}
        self._polled = _Polled()
        self._diagnostics = self.output("/diagnostics")
        self._told_ready = self.create_publisher(String, "graph/ready", GRAPH_QOS)
        self._finished = self.create_publisher(String, "graph/finished", GRAPH_QOS)
        self.create_subscription(Empty, "graph/start", lambda _: self._start(), GRAPH_QOS)
        self.create_timer(1.0, self._publish_diagnostics)
        self._handshake = self.create_timer(0.05, self._match)

    @classmethod
    def import_ahead(cls) -> None:
        """Import what its constructor and first results need; for a process that does not know yet which node it is."""

    # -- endpoints -------------------------------------------------------------------------------------

    def output(self, topic: str) -> Publisher:
        """Publisher of a topic of the table."""
        entry = TOPICS[topic]
        # A subscriber that asks for more than is offered says so itself; each handler costs time at every turn.
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        publisher = self.create_publisher(entry.message, topic, entry.offered or entry.qos, event_callbacks=silent)
        self._outputs.append((topic, publisher))
        return publisher

    def input(
        self,
        topic: str,
        callback: Callable[..., None],
        *,
        raw: bool = False,
        qos: QoSProfile | None = None,
        events: SubscriptionEventCallbacks | None = None,
        with_info: bool = False,
        count_gaps: bool = False,
        in_batches: bool = False,
        polled: bool = False,
    ) -> Subscription:
        """Subscription to a topic of the table.  A message that the callback refuses is counted, not fatal.

        Parameters
        ----------
        with_info : the callback's second argument is rclpy's message info
        count_gaps : count what the publisher sent and this node never saw, being busy or for want of a link
        in_batches : with ``with_info``: after a message take all others that wait, for a node that spins with pauses
        polled : messages wait until :meth:`poll` takes them, without a turn of the executor for each
        """
        guarded = self.guarded(topic, callback)
        gaps = Gaps()

        def with_gaps(message: Any, info: dict[str, Any]) -> None:
            if skipped := gaps.before(info):
                self.missed(topic, skipped)
            guarded(message)

        def alone(message: Any) -> None:
            guarded(message)

        def informed(message: Any, info: dict[str, Any]) -> None:
            guarded(message, info)
            # One turn of the executor costs more than a message; it would take but one.
            for _ in range(subscription_qos.depth if in_batches else 0):
                with subscription.handle:
                    taken = subscription.handle.take_message(TOPICS[topic].message, raw)
                if taken is None:
                    return
                guarded(*taken)

        # rclpy looks at the number of arguments, which its annotation does not say.
        take: Any = with_gaps if count_gaps else informed if with_info else alone
        subscription_qos = qos or TOPICS[topic].qos
        subscription = self.create_subscription(
            TOPICS[topic].message,
            topic,
            take,
            subscription_qos,
            raw=raw,
            event_callbacks=events or SubscriptionEventCallbacks(use_default_callbacks=topic in FROM_OUTSIDE),
            callback_group=self._polled if polled else None,
        )
        self._inputs.append((topic, subscription))
        return subscription

    def poll(self, subscription: Subscription, within_s: float = math.inf) -> None:
        """Take what waits on a subscription that was made with ``polled``; what is not reached in time waits on."""
        end_s = time.monotonic() + within_s
        for _ in range(RESULT_QOS.depth):
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            subscription.callback(taken[0])
            if time.monotonic() > end_s:
                return

    def guarded(self, topic: str, callback: Callable[..., None], stamps: bool = True) -> Callable[..., None]:
        """The callback, of which a refusal is counted and said instead of raised; stamps are checked first."""
        gate = StampGate() if stamps and topic in TOPICS and TOPICS[topic].one_clock else None

        def run(*arguments: Any) -> None:
            self.callbacks_done += 1
            if not self.active:
                return
            try:
                if gate is not None and not isinstance(arguments[0], bytes):
                    stamp = arguments[0].header.stamp
                    gate.check(stamp.sec, stamp.nanosec)
                callback(*arguments)
            except InputError as error:
                self.refuse(f"{topic}: {error}")

        return run

    def refuse(self, why: str) -> None:
        """Count a message that cannot be used, and say why, also after better ones have come."""
        self.count("messages refused")
        self.details[LAST_REFUSED] = why
        self.report(WARN, why)

    def drop_input(self, subscription: Any) -> None:
        """End a subscription."""
        self._inputs = [entry for entry in self._inputs if entry[1] is not subscription]
        self.destroy_subscription(subscription)

    def missed(self, topic: str, amount: int) -> None:
        """Count messages that were sent and that this node never saw."""
        self.count(f"dropped {topic}: busy with the one before", amount)

    # -- start and end ---------------------------------------------------------------------------------

    def on_start(self) -> None:
        """Begin to produce; called once, when every peer is matched or there is no bringup to wait for."""

    def close(self) -> None:
        """Finish what is under way and let go of files, links and threads; called before destruction."""

    def on_stop(self) -> None:
        """The order to stop has come; what has arrived is still worked off after this."""

    def flush(self) -> None:
        """Wait until what was published has arrived, but not long."""
        for _, publisher in self._outputs:
            publisher.wait_for_all_acked(Duration(seconds=1))

    def finish(self) -> None:
        """Tell the graph that this node's source has ended."""
        self._finished.publish(String(data=self.component))

    def _match(self) -> None:
        if self.peers and not self._matched():
            return
        self._handshake.cancel()
        self.ready = True
        self._settled_s = time.monotonic() + (SETTLING_S if self._graph_runs else 0.0)
        if self.peers:
            self._told_ready.publish(String(data=self.component))
        if self._graph_runs or not self.peers:
            self._start()

    @property
    def settled(self) -> bool:
        """Whether nobody waits for this node to come up any more."""
        return time.monotonic() >= self._settled_s

    def _matched(self) -> bool:
        return all(
            publisher.get_subscription_count() + self.handed_over.get(topic, int)() >= subscribers_of(topic, self.peers)
            for topic, publisher in self._outputs
        ) and all(
            subscription.get_publisher_count() >= _publishers(topic, self.peers) for topic, subscription in self._inputs
        )

    def _start(self) -> None:
        if not self.started:
            self.started = True
            self.on_start()

    # -- diagnostics -----------------------------------------------------------------------------------

    def count(self, what: str, amount: int = 1) -> None:
        """Add to a counter that ``/diagnostics`` shows; any thread may."""
        with self._counting:
            self.counters[what] += amount

    def produced(self, stamp_ns: int) -> None:
        """Note that the result of the image of this stamp has just been published."""
        late_s = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        self._latency.add(late_s, time.monotonic())

    def report(self, level: bytes, text: str) -> None:
        """Set the node's state in words; warnings and errors are logged too, at most every 5 s."""
        self._level, self._text = level, text
        if level == ERROR:
            self.get_logger().error(text, throttle_duration_sec=5.0)
        elif level == WARN:
            self.get_logger().warning(text, throttle_duration_sec=5.0)

    def _publish_diagnostics(self) -> None:
        if late := self._latency.text_ms():
            self.details[LATENCY] = late
            self.details[LATENCY_P95] = f"{self._latency.p95_ms():.1f}"
            self.details[RATE] = f"{self._latency.rate_hz(time.monotonic()):.1f}"
        values = {**self.details, **dict(sorted(self.counters.items()))}
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=self._level,
                name=f"{self.get_namespace().strip('/')}/{self.component}",
                message=self._text,
                hardware_id=HARDWARE_ID,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(message)


def _publishers(topic: str, nodes: list[str]) -> int:
    # Every node has diagnostics, which the table therefore leaves out.
    return len(nodes) if topic == "/diagnostics" else publishers_of(topic, nodes)


__all__ = ["ERROR", "HARDWARE_ID", "OK", "WARN", "ComponentNode", "Gaps"]
