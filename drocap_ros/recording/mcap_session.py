"""Sessions of one or several MCAP files."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import METADATA_RECORD, FileRecord
from drocap_ros.recording.mcap.schemas import standard_types
from drocap_ros.recording.mcap.stream import MAGIC, McapChannel, McapStream, counted_channels
from drocap_ros.recording.session import RawMessage, Session, SessionInfo, TopicInfo


class McapSession(Session):
    """Reads the files one after the other."""

    def __init__(self, path: Path, files: list[Path], metadata: dict[str, str]) -> None:
        super().__init__(path)
        # A power cut right after a new file was created leaves it empty; the other files are whole.
        empty = [file for file in files if file.stat().st_size == 0] if len(files) > 1 else []
        files = [file for file in files if file not in empty]
        self.warnings += [f"{file.name} is empty; `drocap recover` repairs the session" for file in empty]
        self._streams = [McapStream(file) for file in files]
        self._metadata = metadata
        self._stores: dict[McapChannel, Any] = {}
        for file in files:
            with file.open("rb") as opened:
                if opened.read(len(MAGIC)) != MAGIC:
                    raise InputError(f"{file}: expected an MCAP file, found other content at its start; check the path")

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of the files."""
        for stream in self._streams:
            stream.damage.clear()
            count = 0
            for message in stream.messages():
                count += 1
                channel = message.channel
                if not topics or channel.topic in topics:
                    yield RawMessage(channel.topic, channel.type_name, message.log_time_ns, message.data, channel)
            self._warn_of_damage(stream, count)

    def decode(self, raw: RawMessage) -> Any:
        """The message as an object with the fields of its definition."""
        channel: McapChannel = raw.source
        store = self._stores.get(channel)
        if store is None:
            store = self._stores[channel] = _typestore(channel)
        if channel.message_encoding == "ros1":
            return store.deserialize_ros1(raw.data, channel.type_name)
        return store.deserialize_cdr(raw.data, channel.type_name)

    def _read_info(self) -> SessionInfo:
        counts: dict[tuple[str, str], int] = {}
        times: list[int] = []
        metadata = dict(self._metadata)
        for stream in self._streams:
            if not _count_by_summary(stream, counts, times):
                self._count_by_messages(stream, counts, times)
            metadata = stream.metadata().get(METADATA_RECORD, {}) | metadata
        return SessionInfo(
            path=self.path,
            kind="rosbag2 folder, MCAP" if self.path.is_dir() else "MCAP",
            topics=tuple(TopicInfo(name, kind, count) for (name, kind), count in sorted(counts.items())),
            start_ns=min(times, default=None),
            end_ns=max(times, default=None),
            metadata=metadata,
        )

    def _count_by_messages(self, stream: McapStream, counts: dict[tuple[str, str], int], times: list[int]) -> None:
        stream.damage.clear()
        record = FileRecord(stream.path.name)
        for message in stream.messages():
            key = (message.channel.topic, message.channel.type_name)
            counts[key] = counts.get(key, 0) + 1
            record.count(message.log_time_ns)
        if record.start_ns is not None:
            times += [record.start_ns, record.end_ns]
        if stream.damage:
            self._warn_of_damage(stream, record.messages)
        else:
            self.warn(f"{stream.path.name}: no usable summary at its end; counted its {record.messages} messages")

    def _warn_of_damage(self, stream: McapStream, count: int) -> None:
        if stream.damage:
            damage = "; ".join(map(str, stream.damage))
            self.warn(f"{stream.path.name}: {damage}; read the {count} messages that are whole")


def _count_by_summary(stream: McapStream, counts: dict[tuple[str, str], int], times: list[int]) -> bool:
    """Add counts and times of a file; False without a usable summary."""
    summary = stream.summary()
    if summary is None or summary.statistics is None:
        return False
    statistics = summary.statistics
    if len(summary.channels) != statistics.channel_count:
        return False
    for channel, count in counted_channels(summary):
        key = (channel.topic, channel.type_name)
        counts[key] = counts.get(key, 0) + count
    if statistics.message_count:
        times += [statistics.message_start_time, statistics.message_end_time]
    return True


def _typestore(channel: McapChannel) -> Any:
    """Types of one channel, from its embedded schema; without one the standard types."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not channel.schema:
        return standard_types()
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel.schema, channel.type_name))
    return store
