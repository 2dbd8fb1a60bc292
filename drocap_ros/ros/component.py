"""Base class of all nodes: parameters, diagnostics, validation of messages, readiness."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

from drocap_ros.config import section_types
from drocap_ros.errors import InputError
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.parameters import Parameters
from drocap_ros.recording.session import Message
from drocap_ros.ros import topics
from drocap_ros.ros.diagnostics import ERROR, HARDWARE_ID, OK, WARN, Key, Latency, of
from drocap_ros.ros.parameters import declare_parameters
from drocap_ros.ros.rclpy_internals import MessageInfo, taking_info
from drocap_ros.ros.topics import FROM_OUTSIDE, KEPT_QOS, RESULT_QOS, TOPICS
from drocap_ros.stamps import StampValidator

#: A simulated time that has not moved for this long, by the real clock, stands still: a busy simulator is faster.
_CLOCK_STANDS_S = 5.0
#: Between looks for a publisher that keeps its last message.
_KEPT_PERIOD_S = 0.5
#: Where a node is too slow, a message that has waited longer than this is passed over: more than two images at 30 Hz.
_LONGEST_WAIT_S = 0.07
#: After a pause of the machine a node that is fast enough works off what has waited for less than this.
_LONGEST_PAUSE_S = 1.0
#: Then all are passed over that have waited longer than this share of it: up to the newest.
_CAUGHT_UP = 0.4
#: Seconds over which a node says how many messages it passes over.
_PASSED_S = 10
#: A node whose input has been silent for this long is idle.
IDLE_S = 3.0


class Gaps:
    """Counts messages that the one publisher of a topic sent and a subscriber never took."""

    def __init__(self) -> None:
        self._last = 0

    def before(self, info: MessageInfo) -> int:
        """Number of messages missing before the message of this info; 0 after a restart of the publisher."""
        number = info["publication_sequence_number"] or 0
        last, self._last = self._last, number
        return number - 1 - last if 0 < last < number - 1 else 0


class Line:
    """Tells of messages that are passed over where a node takes longer for one than it takes the next to come.

    Those that have waited too long are, up to the newest.

    periods : of the node's own work that a message may wait
    """

    def __init__(self, periods: float = 2.0) -> None:
        self.behind = False
        self._periods = periods
        self._last_ns = 0
        self._took_s: deque[float] = deque(maxlen=8)

    def passes_over(self, info: MessageInfo, now_ns: int) -> bool:
        """Whether this message is passed over, by the time since the middleware received it."""
        received_ns = info["received_timestamp"] or now_ns
        since_last_s, self._last_ns = (received_ns - self._last_ns) * 1e-9, received_ns
        # The longest may be a pause of the machine.
        took_s = (sum(self._took_s) - max(self._took_s, default=0.0)) / max(len(self._took_s) - 1, 1)
        waited_s = (now_ns - received_ns) * 1e-9
        limit_s = max(self._periods * took_s, _LONGEST_WAIT_S)
        if self.behind:
            self.behind = waited_s > _CAUGHT_UP * limit_s
        else:
            self.behind = waited_s > (limit_s if took_s > since_last_s else max(limit_s, _LONGEST_PAUSE_S))
        return self.behind

    def took(self, seconds: float) -> None:
        """Record how long the last message took that was not passed over."""
        self._took_s.append(seconds)


class ComponentNode(Node):
    """A node of the capture graph.

    Publishes, beside its own topics (``topics.NODES``), ``/diagnostics`` once a second.  ROS parameter ``graph_nodes``
    names the nodes of a graph that a bringup starts: the node is ready as soon as its publishers and subscriptions are
    matched with theirs, without the parameter at once.

    config : the component's parameters; ROS parameter overrides take precedence
    transport : a simulated link in this process, instead of that of the configuration
    node_kwargs : passed on to :class:`rclpy.node.Node` (context, namespace, parameter_overrides, ...)
    """

    component: ClassVar[str]
    config: Parameters
    #: Topics without which the node has nothing to do.
    needs: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self, config: Parameters | None = None, *, transport: Transport | None = None, **node_kwargs: Any
    ) -> None:
        node_kwargs.setdefault("namespace", "/drocap")
        super().__init__(self.component, **node_kwargs)
        #: Whether ROS' parameter ``use_sim_time`` is set: every time is then that of ``/clock``, and no result depends
        #: on how fast this machine is.
        self.simulated = bool(self.get_parameter("use_sim_time").value)
        self.add_on_set_parameters_callback(self._refuse_another_clock)
        peers = self.declare_parameter("graph_nodes", "").value
        #: All nodes of the graph; empty without a bringup.
        self.peers: list[str] = [name for name in peers.split(",") if name]
        #: Nodes of the graph that one thread runs, by name: they read each other's parameters without a service.
        self.beside: dict[str, ComponentNode] = {self.component: self}
        self.config = declare_parameters(self, config or section_types()[self.component]())
        self.transport = transport
        self.counters: Counter[str] = Counter()
        self._counting = threading.Lock()
        self.details: dict[str, str] = {Key.READY: "false"}
        self._latency = Latency()
        #: Results so far; with those and what was missed the node says whether this machine keeps up.
        self.handled = 0
        self._passed: deque[tuple[int, int]] = deque([(0, 0)], maxlen=_PASSED_S)
        self.ready = False
        #: Whether messages are taken; only a managed node is ever inactive.
        self.active = True
        #: Error of a thread of this node, raised where the node spins.
        self.failure: BaseException | None = None
        self.callbacks_done = 0
        self._heard_s: dict[str, float] = {}
        self._begin_s = 0.0
        self._level = OK
        self._text = "running"
        #: Publishers by the names of their topics.
        self.outputs: list[tuple[str, Publisher]] = []
        self._inputs: list[tuple[str, Subscription]] = []
        self._kept: Subscription | None = None  # of what was published before this node
        self._diagnostics = self.output("/diagnostics")
        self.create_timer(1.0, self.publish_diagnostics)
        # Before the simulated time begins the endpoints are matched already.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._matching = self.create_timer(0.05, self.match, clock=steady)
        self._clock_ns, self._clock_stands = -1, False
        if self.simulated:
            self.create_timer(_CLOCK_STANDS_S, self._watch_clock, clock=steady)
        self.start_up()

    def start_up(self) -> None:
        """Last step of the constructor."""
        self.build()

    def build(self) -> None:
        """Declare endpoints and state; the parameters are known."""

    # -- time ------------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Clock of the stamps, ns."""
        return int(self.get_clock().now().nanoseconds)

    def now_s(self) -> float:
        """Clock of periods and ages, s: monotonic, also while the machine is suspended, or the simulated time."""
        return self.now_ns() * 1e-9 if self.simulated else time.clock_gettime(time.CLOCK_BOOTTIME)

    def _watch_clock(self) -> None:
        """Publish the status while the simulated time stands still, and with it the timer that does so."""
        last_ns, self._clock_ns = self._clock_ns, self.now_ns()
        self._clock_stands = self._clock_ns == last_ns
        if self._clock_stands:
            self.publish_diagnostics()

    def _refuse_another_clock(self, parameters: list[Parameter]) -> SetParametersResult:
        changed = any(p.name == "use_sim_time" and p.value != self.simulated for p in parameters)
        reason = "use_sim_time: expected at the start of the node; start it again" if changed else ""
        return SetParametersResult(successful=not changed, reason=reason)

    # -- endpoints -------------------------------------------------------------------------------------

    def output(self, topic: str) -> Publisher:
        """Publisher of a topic of the table."""
        entry = TOPICS[topic]
        # The subscriber reports an incompatible quality of service itself.
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        publisher = self.create_publisher(entry.message, topic, entry.offered or entry.qos, event_callbacks=silent)
        self.outputs.append((topic, publisher))
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
        newest: bool = False,
    ) -> Subscription:
        """Subscription to a topic of the table; an InputError of the callback is counted and reported, not raised.

        with_info : the callback's second argument is rclpy's message info
        newest : messages that have waited in line are passed over and counted; in simulated time none waits
        """
        entry = TOPICS[topic]
        if newest:
            take = self.newest(topic, callback, stamps=entry.one_clock)
        else:
            take = self.guarded(topic, callback, stamps=entry.one_clock)
            take = taking_info(take) if with_info else take
        if qos is None:  # in simulated time no driver publishes, and every message counts
            qos = RESULT_QOS if topic == "camera_info" and self.simulated else entry.qos
        subscribe = partial(self.create_subscription, entry.message, topic, take, raw=raw)
        events = events or SubscriptionEventCallbacks(use_default_callbacks=topic in FROM_OUTSIDE)
        subscription: Subscription = subscribe(qos, event_callbacks=events)
        self._inputs.append((topic, subscription))
        if topic == "camera_info" and not self.simulated:
            self.create_timer(_KEPT_PERIOD_S, partial(self._hear_kept, topic, subscribe))
        return subscription

    def newest(self, topic: str, callback: Callable[..., None], *, stamps: bool) -> Callable[..., None]:
        """Wrap a callback as :meth:`guarded`; messages that have waited in line are passed over and counted."""
        if self.simulated:
            return self.guarded(topic, callback, stamps=stamps)
        line = Line()

        def take(message: Message, info: MessageInfo) -> None:
            begin_ns = time.time_ns()
            if line.passes_over(info, begin_ns):
                self.missed(topic, 1)
                return
            callback(message)
            line.took((time.time_ns() - begin_ns) * 1e-9)

        return taking_info(self.guarded(topic, take, stamps=stamps))

    def _hear_kept(self, topic: str, subscribe: Callable[..., Subscription]) -> None:
        """Subscribe a second time, until a message comes, where a publisher keeps its last one for late subscribers."""
        if not self.active:
            self._heard_s.pop(topic, None)  # what was heard meanwhile was not taken
        elif topic not in self._heard_s:
            offered = [p.qos_profile for p in self.get_publishers_info_by_topic(self.resolve_topic_name(topic))]
            if self._kept is None and any(qos.durability == KEPT_QOS.durability for qos in offered):
                silent = SubscriptionEventCallbacks(use_default_callbacks=False)
                self._kept = subscribe(KEPT_QOS, event_callbacks=silent)
            return
        if self._kept is not None:
            self.destroy_subscription(self._kept)
            self._kept = None

    def guarded(self, topic: str, callback: Callable[..., None], *, stamps: bool) -> Callable[..., None]:
        """Wrap a callback: an InputError is counted and reported, not raised; with ``stamps`` they are validated."""
        validator = StampValidator() if stamps else None

        def run(*arguments: Message) -> None:
            self.callbacks_done += 1
            self._heard_s[topic] = self.now_s()
            if not self.active:
                return
            try:
                if validator is not None and not isinstance(arguments[0], bytes):
                    stamp = arguments[0].header.stamp
                    validator.check(stamp.sec, stamp.nanosec)
                callback(*arguments)
            except InputError as error:
                self.refuse(f"{topic}: {error}")

        return run

    def refuse(self, reason: str) -> None:
        """Count a refused message and keep the reason on ``/diagnostics``."""
        self.count(Key.MESSAGES_REFUSED)
        self.details[Key.LAST_REFUSED] = reason
        self.report(WARN, reason)

    def thread(self, body: Callable[[], None], name: str) -> threading.Thread:
        """A thread of this node, not started yet; an error in it is raised where the node spins."""

        def run() -> None:
            try:
                body()
            except Exception as error:  # noqa: BLE001 -- whatever it is, it ends the node
                self.failure = error

        return threading.Thread(target=run, name=name, daemon=True)

    def missed(self, topic: str, amount: int) -> None:
        """Count messages that were published and never taken."""
        self.count(of(Key.MISSED, topic), amount)

    # -- start and end ---------------------------------------------------------------------------------

    def on_ready(self) -> None:
        """Begin to work; called once, when every peer is matched."""

    def on_stop(self) -> None:
        """React to the order to stop; messages that have arrived are still processed after this."""

    def flush(self) -> None:
        """Wait until published messages have arrived, at most a second each."""
        for _, publisher in self.outputs:
            publisher.wait_for_all_acked(Duration(seconds=1))

    def close(self) -> None:
        """Finish work in progress and release files, links and threads; called before destruction."""

    def match(self) -> None:
        """Become ready if every peer is matched."""
        if not self.peers or self._matched():
            self.become_ready()

    def become_ready(self) -> None:
        """Begin to work."""
        self._matching.cancel()
        self.ready, self._begin_s = True, self.now_s()
        self.details[Key.READY] = "true"
        self.on_ready()
        self.publish_diagnostics()

    def _matched(self) -> bool:
        return all(
            publisher.get_subscription_count() >= topics.subscribers_of(topic, self.peers)
            for topic, publisher in self.outputs
        ) and all(
            subscription.get_publisher_count() >= topics.publishers_of(topic, self.peers)
            for topic, subscription in self._inputs
        )

    # -- diagnostics -----------------------------------------------------------------------------------

    def count(self, key: str, amount: int = 1) -> None:
        """Add to a counter of ``/diagnostics``; thread-safe."""
        with self._counting:
            self.counters[key] += amount

    def produced(self, stamp_ns: int) -> None:
        """Note that the result of the image of this stamp has just been published."""
        self.handled += 1
        self._latency.add((self.now_ns() - stamp_ns) * 1e-9, self.now_s())

    def report(self, level: bytes, text: str) -> None:
        """Set level and text of the node's status; warnings and errors are logged too, at most every 5 s."""
        self._level, self._text = level, text
        if level == ERROR:
            self.get_logger().error(text, throttle_duration_sec=5.0)
        elif level == WARN:
            self.get_logger().warning(text, throttle_duration_sec=5.0)

    def idle_reason(self) -> str:
        """Why the node has nothing to do, as words; "" = it works, or its status says why not."""
        if not self.active:
            return ""
        if not self.ready:
            return "waiting for the other nodes of the graph"
        if self._clock_stands:
            return "use_sim_time is set, and /clock " + ("stands still" if self._clock_ns else "has not come yet")
        now_s = self.now_s()
        for topic in self.needs:
            heard_s = self._heard_s.get(topic)
            silent_s = now_s - (self._begin_s if heard_s is None else heard_s)
            if silent_s > IDLE_S:
                since = "since the start" if heard_s is None else f"for {silent_s:.0f} s"
                nobody = "" if self.count_publishers(topic) else ": nobody publishes it"
                return f"no message on {topic} {since}{nobody}"
        return ""

    def _passed_over(self) -> int:
        """Share of the last images that were passed over, %."""
        missed = sum(number for key, number in self.counters.items() if key.startswith(f"{Key.MISSED}/"))
        handled, (handled_before, missed_before) = self.handled, self._passed[0]
        self._passed.append((handled, missed))
        missed, handled = missed - missed_before, handled - handled_before
        share = round(100 * missed / max(missed + handled, 1))
        if handled:
            self.details[Key.PASSED_OVER] = str(share)
        return share

    def publish_diagnostics(self) -> None:
        """Publish the status now; a timer does so once a second."""
        level, text = self._level, self._text
        if level != ERROR and (reason := self.idle_reason()):
            level, text = WARN, f"idle: {reason}"
        if passed := self._passed_over():
            text += f"; this machine passes over {passed} %"
        if late_ms := self._latency.percentiles_ms():
            for key, value in zip((Key.LATENCY_P50, Key.LATENCY_P95, Key.LATENCY_P99), late_ms, strict=True):
                self.details[key] = f"{value:.1f}"
            self.details[Key.RATE] = f"{self._latency.rate_hz(self.now_s()):.1f}"
        with self._counting:
            values = {**self.details, **dict(sorted(self.counters.items()))}
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [
            DiagnosticStatus(
                level=level,
                name=f"{self.get_namespace().strip('/')}/{self.component}",
                message=text,
                hardware_id=HARDWARE_ID,
                values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(message)


__all__ = ["ERROR", "HARDWARE_ID", "OK", "WARN", "ComponentNode", "Gaps", "Line", "MessageInfo"]
