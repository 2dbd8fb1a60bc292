"""Node ``session_player``: publishes a recorded session again, byte for byte, at the pace of the recording.

Publishes the topics of the session whose types are installed here, and ``/clock`` (rosgraph_msgs/Clock, the
recording's time).  Topics of the namespace that was recorded come out in the node's own.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Iterator
from typing import Any

from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock

from drocap_ros.errors import DrocapError, InputError
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, RawMessage, Session, TopicInfo, open_session
from drocap_ros.ros.component import ERROR, OK, ComponentNode
from drocap_ros.ros.conversions import stamp_to_ros
from drocap_ros.ros.spin import node_main
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, RESULT_QOS, TOPICS

#: Topics that this graph publishes itself; those of the recording only when they are named.
_OWN = ("/diagnostics", "/clock")
_CLOCK_PERIOD_S = 0.01


class SessionPlayerNode(ComponentNode):
    """Reads in a thread of its own; memory is that of one chunk."""

    component = "session_player"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
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
        self._told_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="session_player", daemon=True)

    def on_start(self) -> None:
        """Begin to publish."""
        self._thread.start()

    def close(self) -> None:
        """Stop and close the session."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._session.close()

    def _publisher(self, topic: TopicInfo) -> Publisher:
        recorded = self._session.info.metadata.get("namespace", "/drocap").rstrip("/") + "/"
        name = topic.name.removeprefix(recorded)
        if name in TOPICS:
            return self.output(name)
        package, _, kind = topic.type_name.split("/")
        message = getattr(importlib.import_module(f"{package}.msg"), kind)
        qos = IMAGE_RECORDING_QOS if topic.type_name in (IMAGE, COMPRESSED_IMAGE) else RESULT_QOS
        return self.create_publisher(message, topic.name, qos)

    def _run(self) -> None:
        try:
            while True:
                self._play_once()
                if not self.config.loop or self._stop.is_set():
                    break
                self.count("rounds")
            self.report(OK, "the session has ended")
        except DrocapError as error:
            self.report(ERROR, str(error))
        for warning in self._session.warnings:
            self.get_logger().warning(warning)
        if not self._stop.is_set():
            self.flush()
            self.finish()

    def _play_once(self) -> None:
        start_ns = self._session.info.start_ns or 0
        origin_ns = start_ns + round(self.config.start_s * 1e9)
        begin_s = time.monotonic()
        self._told_ns = origin_ns - 1  # a new round goes back in time, nothing else does
        for raw in self._messages(origin_ns):
            due_s = begin_s + (raw.log_time_ns - origin_ns) * 1e-9 / self.config.rate
            self._wait_until(due_s, begin_s, origin_ns)
            if self._stop.is_set():
                return
            self._tell_time(raw.log_time_ns)
            self._publishers_by_topic[raw.topic].publish(raw.data)
            self.count("messages")

    def _messages(self, origin_ns: int) -> Iterator[RawMessage]:
        wanted = frozenset(self._publishers_by_topic)
        return (raw for raw in self._session.raw_messages(wanted) if raw.log_time_ns >= origin_ns)

    def _wait_until(self, due_s: float, begin_s: float, origin_ns: int) -> None:
        while (left_s := due_s - time.monotonic()) > 0 and not self._stop.wait(min(left_s, _CLOCK_PERIOD_S)):
            self._tell_time(origin_ns + round((time.monotonic() - begin_s) * self.config.rate * 1e9))

    def _tell_time(self, now_ns: int) -> None:
        if self._clock_output is not None and now_ns > self._told_ns:
            self._told_ns = now_ns
            self._clock_output.publish(Clock(clock=stamp_to_ros(now_ns)))


def _chosen(session: Session, wanted: str) -> list[TopicInfo]:
    """Topics to publish: those named, else all that can be; types that are not installed here are told."""
    names = wanted.split()
    there = [topic for topic in session.info.topics if topic.count]
    for name in names:
        if not any(_fits(topic.name, name) for topic in there):
            raise InputError(
                f"{session.path}: expected topic {name!r} with messages, found {', '.join(t.name for t in there)}; "
                "name some of these"
            )
    if names:
        chosen = [topic for topic in there if any(_fits(topic.name, name) for name in names)]
    else:
        chosen = [topic for topic in there if topic.name not in _OWN]
    known = [topic for topic in chosen if _is_installed(topic.type_name)]
    for topic in chosen:
        if topic not in known:
            session.warn(f"{topic.name}: type {topic.type_name} is not installed here: left out")
    return known


def _fits(topic: str, name: str) -> bool:
    return topic == name or topic.endswith("/" + name.lstrip("/"))


def _is_installed(type_name: str) -> bool:
    package, _, kind = type_name.partition("/msg/")
    try:
        return hasattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, ValueError):
        return False


def main() -> int:
    """Run the node as a process."""
    return node_main(SessionPlayerNode)


if __name__ == "__main__":
    raise SystemExit(main())
