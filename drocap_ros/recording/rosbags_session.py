"""Recordings read by the package ``rosbags``: rosbag1, rosbag2 with sqlite3 or compressed files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.mcap.schemas import standard_types
from drocap_ros.recording.session import FORMS, Message, RawMessage, Session, SessionInfo, TopicInfo


class RosbagsSession(Session):
    """Wraps ``rosbags.highlevel.AnyReader``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        from rosbags.highlevel import AnyReader

        try:
            self._reader = AnyReader([path], default_typestore=standard_types())
            self._reader.open()
        except Exception as error:  # noqa: BLE001  # rosbags passes on any error of its storages
            raise InputError(f"{path}: expected {FORMS} that can be read; {first_line(error)}") from None

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of their log times."""
        connections = [c for c in self._reader.connections if not topics or c.topic in topics]
        if not connections:
            return
        messages = self._reader.messages(connections)
        while True:
            try:
                connection, log_time_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001  # a damaged file: the messages before it are whole
                self.warn(f"cut off or damaged: {first_line(error)}; read the messages before it")
                return
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, bytes(data), connection)

    def decode(self, raw: RawMessage) -> Message:
        """The message as an object with the fields of its definition."""
        return self._reader.deserialize(raw.data, raw.type_name)

    def _read_info(self) -> SessionInfo:
        counts = Counter[tuple[str, str]]()
        for connection in self._reader.connections:
            counts[connection.topic, connection.msgtype] += connection.msgcount
        any_message = counts.total() > 0
        return SessionInfo(
            path=self.path,
            kind="rosbag2 folder" if self.path.is_dir() else f"rosbag ({self.path.suffix})",
            topics=tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items())),
            start_ns=self._reader.start_time if any_message else None,
            end_ns=self._reader.end_time - 1 if any_message else None,
            metadata={},
        )

    def close(self) -> None:
        """Release the files."""
        if self._reader.stack is not None:
            self._reader.close()
