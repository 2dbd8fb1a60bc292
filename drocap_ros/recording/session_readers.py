"""Readers of sessions: MCAP files, and by the package ``rosbags`` rosbag1 and rosbag2 with sqlite3 or compression."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.mcap.metadata import METADATA_FILE, METADATA_RECORD, FileRecord, standard_types, types_of
from drocap_ros.recording.mcap.stream import MAGIC, McapChannel, McapStream, counted_channels
from drocap_ros.recording.session import FORMS, Message, RawMessage, Session, SessionInfo

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore
import base64
import json
import struct
from types import SimpleNamespace

from drocap_ros.recording.telemetry.djmd_layouts import Value, read_message

_TEXT = ("format", "encoding", "frame_id")
_COUNTS = ("width", "height", "step")
_FIELDS: dict[str, dict[str, int]] = {
    "foxglove.CompressedImage": {"timestamp": 1, "data": 2, "format": 3, "frame_id": 4},
    "foxglove.CompressedVideo": {"timestamp": 1, "frame_id": 2, "data": 3, "format": 4},
    "foxglove.RawImage": {"timestamp": 1, "width": 2, "height": 3, "encoding": 4, "step": 5, "data": 6, "frame_id": 7},
}
_LATEST_S = 2**63 // 10**9  # s: ns must fit into 64 bits with a sign


def foxglove_message(data: bytes, encoding: str, type_name: str) -> SimpleNamespace:
    """One message.

    Raises
    ------
    Exception
        Of any kind, when it is of another encoding or type, or damaged.
    """
    numbers = _FIELDS[type_name]
    if encoding == "json":
        found = json.loads(data)
        time = found.get("timestamp", {})
        values = {name: found.get(name, "" if name in _TEXT else 0) for name in numbers}
        values["data"] = base64.b64decode(found.get("data", ""), validate=True)
        time = {1: time.get("sec", 0), 2: time.get("nsec", 0)}
    else:
        by_number = read_message(data)
        values = {name: _of_protobuf(name, by_number.get(number)) for name, number in numbers.items()}
        stamp = by_number.get(numbers["timestamp"], b"")
        time = read_message(stamp) if isinstance(stamp, bytes) else {}
    sec, nanosec = int(time.get(1, 0)), int(time.get(2, 0))
    if not 0 <= sec < _LATEST_S:
        raise InputError(f"timestamp: expected a time after 1970, got {sec} s")
    values["timestamp"] = SimpleNamespace(sec=sec, nanosec=nanosec)
    kinds = {**dict.fromkeys(_TEXT, str), **dict.fromkeys(_COUNTS, int)}
    return SimpleNamespace(**{name: kinds.get(name, lambda v: v)(value) for name, value in values.items()})


def _of_protobuf(name: str, value: Value | None) -> Value | str:
    """A field; proto3 leaves out zeros and empty ones."""
    if name == "data" or name in _TEXT:
        content = value if isinstance(value, bytes) else b""
        return content.decode("utf-8", "replace") if name in _TEXT else content
    # The reader takes 32 fixed bits for a float; these are an integer.
    return struct.unpack("<I", struct.pack("<f", value))[0] if isinstance(value, float) else 0


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
        self._stores: dict[McapChannel, Typestore] = {}
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

    def decode(self, raw: RawMessage) -> Message:
        """The message as an object with the fields of its definition."""
        channel = raw.source
        assert isinstance(channel, McapChannel)
        if channel.message_encoding in ("json", "protobuf"):
            return foxglove_message(raw.data, channel.message_encoding, channel.type_name)
        store = self._stores.get(channel)
        if store is None:
            schema, name = channel.schema, channel.type_name
            store = self._stores[channel] = types_of(name, schema) if schema else standard_types()
        if channel.message_encoding == "ros1":
            return store.deserialize_ros1(raw.data, channel.type_name)
        return store.deserialize_cdr(raw.data, channel.type_name)

    def _read_info(self) -> SessionInfo:
        counts = Counter[tuple[str, str]]()
        times: list[int] = []
        metadata = dict(self._metadata)
        for stream in self._streams:
            of_file, span = self._content(stream)
            counts.update(of_file)
            times += span
            metadata = stream.metadata().get(METADATA_RECORD, {}) | metadata
        return self._info_of("rosbag2 folder, MCAP" if self.path.is_dir() else "MCAP", counts, times, metadata)

    def _content(self, stream: McapStream) -> tuple[Counter[tuple[str, str]], list[int]]:
        """Messages by (topic, type) and log times of the first and last one, by the summary or else by reading all."""
        counts = Counter[tuple[str, str]]()
        summary = stream.summary()
        statistics = None if summary is None else summary.statistics
        if summary is not None and statistics is not None and len(summary.channels) == statistics.channel_count:
            for channel, count in counted_channels(summary):
                counts[channel.topic, channel.type_name] += count
            return counts, [statistics.message_start_time, statistics.message_end_time] if counts.total() else []
        stream.damage.clear()
        record = FileRecord(stream.path.name)
        for message in stream.messages():
            counts[message.channel.topic, message.channel.type_name] += 1
            record.count(message.log_time_ns)
        self._warn_of_damage(stream, record.messages)
        if not stream.damage:
            self.warn(f"{stream.path.name}: no usable summary at its end; counted its {record.messages} messages")
        return counts, [] if record.start_ns is None else [record.start_ns, record.end_ns]

    def _warn_of_damage(self, stream: McapStream, count: int) -> None:
        if stream.damage:
            damage = "; ".join(map(str, stream.damage))
            self.warn(f"{stream.path.name}: {damage}; read the {count} messages that are whole")


class RosbagsSession(Session):
    """Wraps ``rosbags.highlevel.AnyReader``."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        from rosbags.highlevel import AnyReader

        try:
            # A folder without metadata.yaml is read by its files.
            there = sorted(path.glob("*.db3")) or sorted(path.glob("*.bag"))
            files = [path] if path.is_file() or (path / METADATA_FILE).is_file() else there
            self._reader = AnyReader(files, default_typestore=standard_types())
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
        times = [self._reader.start_time, self._reader.end_time - 1] if counts.total() else []
        kind = "rosbag2 folder" if self.path.is_dir() else f"rosbag ({self.path.suffix})"
        return self._info_of(kind, counts, times, {})

    def close(self) -> None:
        """Release the files."""
        if self._reader.stack is not None:
            self._reader.close()
