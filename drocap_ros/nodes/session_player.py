"""Node ``session_player``: publishes a recorded session again, byte for byte, at the speed of the recording.

Publishes the topics of the session whose types are installed here, and ``/clock`` (rosgraph_msgs/Clock, the
recording's time).  Topics of the recorded namespace are published in the node's own.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator

from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from drocap_ros.errors import DrocapError, InputError
from drocap_ros.recording.mcap.session_config import SessionPlayerConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, RawMessage, Session, TopicInfo
from drocap_ros.ros.component import ERROR
from drocap_ros.ros.conversions import stamp_to_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.lifecycle import ThreadedSource
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, RESULT_QOS, TOPICS

#: Topics that this graph publishes itself; played only when they are named.
_OWN = ("/diagnostics", "/clock")
#: Of /clock between messages, s: that of the simulated time of a graph.
_CLOCK_PERIOD_S = 0.01


class SessionPlayerNode(ThreadedSource):
    """Reads in a thread of its own; holds one chunk in memory."""

    component = "session_player"
    config: SessionPlayerConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        if not self.config.session:
            raise InputError("session_player.session: expected a session folder or .mcap, got nothing; name one")
        self._session = open_session(self.config.session)
        self._publishers_by_topic = {t.name: self._publisher(t) for t in _chosen(self._session, self.config.topics)}
        if self._session.info.start_ns is None or not self._publishers_by_topic:
            raise InputError(f"{self.config.session}: expected messages to publish, found none; check the session")
        if self.config.start_s > self._session.info.duration_s:
            raise InputError(
                f"session_player.start_s: expected at most {self._session.info.duration_s:.1f} s, the session's length,"
                f" got {self.config.start_s:g}"
            )
        self._clock_output = self.create_publisher(Clock, "/clock", 10) if self.config.clock else None
        self._clock_ns = 0

    def close(self) -> None:
        """Stop and close the session."""
        super().close()
        self._session.close()

    def _publisher(self, topic: TopicInfo) -> Publisher:
        recorded = self._session.info.metadata.get("namespace", "/drocap").rstrip("/") + "/"
        name = topic.name.removeprefix(recorded)
        for own in (name, f"/{name}"):  # TF of another namespace than the default one is recorded as NAMESPACE/tf
            if own in TOPICS:
                return self.output(own)
        package, _, kind = topic.type_name.split("/")
        message = getattr(importlib.import_module(f"{package}.msg"), kind)
        qos = IMAGE_RECORDING_QOS if topic.type_name in (IMAGE, COMPRESSED_IMAGE) else RESULT_QOS
        return self.create_publisher(message, topic.name, qos)

    def play(self) -> None:
        """Publish the session, in a loop if configured."""
        self.stopping.wait(self.config.delay_s)
        try:
            while True:
                self._play_once()
                if not self.config.loop or self.stopping.is_set():
                    break
                self.count(Key.ROUNDS)
        except DrocapError as error:
            self.report(ERROR, str(error))
        for warning in self._session.warnings:
            self.get_logger().warning(warning)
        if not self.stopping.is_set():
            self.flush()
            self.end()

    def _play_once(self) -> None:
        start_ns = self._session.info.start_ns or 0
        origin_ns = start_ns + round(self.config.start_s * 1e9)
        begin_s = time.monotonic()
        self._clock_ns = origin_ns - 1  # only a new round goes back in time
        for raw in self._messages(origin_ns):
            due_s = begin_s + (raw.log_time_ns - origin_ns) * 1e-9 / self.config.rate
            self._wait_until(due_s, begin_s, origin_ns)
            if self.stopping.is_set():
                return
            self._publish_clock(raw.log_time_ns)
            if self.active:
                self._publishers_by_topic[raw.topic].publish(raw.data)
                self.count(Key.MESSAGES)

    def _messages(self, origin_ns: int) -> Iterator[RawMessage]:
        wanted = frozenset(self._publishers_by_topic)
        return (raw for raw in self._session.raw_messages(wanted) if raw.log_time_ns >= origin_ns)

    def _wait_until(self, due_s: float, begin_s: float, origin_ns: int) -> None:
        while (left_s := due_s - time.monotonic()) > 0 and not self.stopping.wait(min(left_s, _CLOCK_PERIOD_S)):
            self._publish_clock(origin_ns + round((time.monotonic() - begin_s) * self.config.rate * 1e9))

    def _publish_clock(self, now_ns: int) -> None:
        if self._clock_output is not None and now_ns > self._clock_ns:
            self._clock_ns = now_ns
            self._clock_output.publish(Clock(clock=stamp_to_ros(now_ns)))


def _chosen(session: Session, wanted: str) -> list[TopicInfo]:
    """Topics to publish: the named ones, else all; a type that is not installed is left out with a warning."""
    installed = []
    for topic in _named(session, wanted.split()):
        if _is_installed(topic.type_name):
            installed.append(topic)
        else:
            session.warn(f"{topic.name}: type {topic.type_name} is not installed here: left out")
    return installed


def _named(session: Session, names: list[str]) -> list[TopicInfo]:
    present = [topic for topic in session.info.topics if topic.count]
    for name in names:
        if not any(_fits(topic.name, name) for topic in present):
            raise InputError(
                f"{session.path}: expected topic {name!r} with messages, found {', '.join(t.name for t in present)}; "
                "name some of these"
            )
    return [topic for topic in present if _is_wanted(topic.name, names)]


def _is_wanted(topic: str, names: list[str]) -> bool:
    return any(_fits(topic, name) for name in names) if names else topic not in _OWN


def _fits(topic: str, name: str) -> bool:
    return topic == name or topic.endswith("/" + name.lstrip("/"))


def _is_installed(type_name: str) -> bool:
    package, _, kind = type_name.partition("/msg/")
    try:
        return hasattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, ValueError):
        return False
