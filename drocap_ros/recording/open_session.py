"""Opens a recording: ours, rosbag2's (MCAP or sqlite3), one ``.mcap`` or ``.bag``; bags without an index."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError, first_line
from drocap_ros.file_kind import RECORDINGS, FileKind, file_kind, unpacking
from drocap_ros.recording.damaged_bags import BagScan, SqliteScan, journal_of
from drocap_ros.recording.mcap.metadata import METADATA_FILE, custom_metadata, read_metadata, storage_files, types_of
from drocap_ros.recording.session import FORMS, Message, RawMessage, Session, SessionInfo, unpacked

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore
import base64
import json
import struct
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.recording.mcap.metadata import METADATA_RECORD, FileRecord, standard_types
from drocap_ros.recording.mcap.stream import MAGIC, McapChannel, McapStream, counted_channels
from drocap_ros.recording.telemetry.djmd_layouts import Value, read_message

_TEXT = ("format", "encoding", "frame_id", "distortion_model")
_COUNTS = ("width", "height", "step")
_ROWS = ("D", "K", "R", "P")
_FIELDS: dict[str, dict[str, int]] = {
    "foxglove.CompressedImage": {"timestamp": 1, "data": 2, "format": 3, "frame_id": 4},
    "foxglove.CompressedVideo": {"timestamp": 1, "frame_id": 2, "data": 3, "format": 4},
    "foxglove.RawImage": {"timestamp": 1, "width": 2, "height": 3, "encoding": 4, "step": 5, "data": 6, "frame_id": 7},
    "foxglove.CameraCalibration": {
        "timestamp": 1,
        "width": 2,
        "height": 3,
        "distortion_model": 4,
        "D": 5,
        "K": 6,
        "R": 7,
        "P": 8,
        "frame_id": 9,
    },
}
_LATEST_S = 2**63 // 10**9  # s: ns must fit into 64 bits with a sign


def foxglove_message(data: bytes, encoding: str, type_name: str) -> SimpleNamespace:
    """One message.

    raises Exception : of any kind, when it is of another encoding or type, or damaged
    """
    numbers = _FIELDS[type_name]
    if encoding == "json":
        found = json.loads(data)
        time = found.get("timestamp", {})
        values = {name: found.get(name, "" if name in _TEXT else [] if name in _ROWS else 0) for name in numbers}
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
    kinds = {**dict.fromkeys(_TEXT, str), **dict.fromkeys(_COUNTS, int), **dict.fromkeys(_ROWS, np.float64)}
    return SimpleNamespace(**{name: kinds.get(name, lambda v: v)(value) for name, value in values.items()})


def _of_protobuf(name: str, value: Value | None) -> Value | str | np.ndarray:
    """A field; proto3 leaves out zeros and empty ones."""
    content = value if isinstance(value, bytes) else b""
    if name in _ROWS:
        return np.frombuffer(content, "<f8")
    if name == "data" or name in _TEXT:
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
        self._streams = [McapStream(file, resync=True, trusting=True) for file in files]
        self._metadata = metadata
        self._stores: dict[McapChannel, Typestore] = {}
        for file in files:
            with file.open("rb") as opened:
                if opened.read(len(MAGIC)) != MAGIC:
                    raise InputError(f"{file}: expected an MCAP file, found other content at its start; check the file")

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of the files."""
        for stream in self._streams:
            stream.damage.clear()
            count = 0
            for message in stream.messages():
                count += 1
                channel = message.channel
                if not topics or channel.topic in topics:
                    yield RawMessage(
                        channel.topic, channel.type_name, message.log_time_ns, unpacked(message.data), channel
                    )
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
            # The files alone say what is in them: the description may be missing, or have been edited.
            there = sorted(path.glob("[!.]*.db3")) or sorted(path.glob("[!.]*.bag"))
            files = there if path.is_dir() and there else [path]
            self._reader = AnyReader(files, default_typestore=standard_types())
            self._reader.open()
        except Exception as error:  # noqa: BLE001  # rosbags passes on any error of its storages
            raise InputError(f"{path}: expected {FORMS} that can be read; {first_line(error)}") from None

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of their log times."""
        connections = [c for c in self._reader.connections if not topics or c.topic in topics]
        if not connections:
            return
        messages, begin_ns, skip_ns = self._reader.messages(connections), self._reader.start_time, _SKIP_NS
        while True:
            try:
                connection, log_time_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:  # noqa: BLE001  # a damaged file: the messages before it, and behind it, are whole
                self.warn(f"damaged: {first_line(error)}; the messages about the damage are missing")
                # The time of the damage is unknown: steps over it grow until messages come again.
                begin_ns, skip_ns = begin_ns + skip_ns, 2 * skip_ns
                if begin_ns >= self._reader.end_time:
                    return
                messages = self._reader.messages(connections, start=begin_ns)
                continue
            begin_ns, skip_ns = log_time_ns, _SKIP_NS
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, unpacked(bytes(data)), connection)

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


#: First step over damage whose time is unknown, ns.
_SKIP_NS = 1_000_000
_SUFFIXES = (".mcap", ".bag", ".db3")
#: Ending of their files that are compressed as a whole.
_PACKED = ".zstd"


def is_recording(path: str | Path) -> bool:
    """Whether :func:`open_session` may read a path: by its first bytes, its name, or the names in a folder."""
    path = _folder_of(Path(path))
    if path.is_dir():
        return (path / METADATA_FILE).is_file() or any(p.suffix in (*_SUFFIXES, _PACKED) for p in path.glob("[!.]*"))
    return path.suffix in _SUFFIXES or (path.is_file() and file_kind(path) in RECORDINGS)


def _folder_of(path: Path) -> Path:
    """The recording itself, of its description in the folder the folder."""
    return path.parent if path.name == METADATA_FILE and path.is_file() else path


def open_session(path: str | Path) -> Session:
    """Open a recording."""
    path = _folder_of(Path(path))
    if not path.exists():
        raise InputError(f"{path}: expected {FORMS}, found no such file; check the path")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: expected {FORMS}, found a pipe or device; name a file or folder")
    if not is_recording(path):
        found = "a folder without one" if path.is_dir() else file_kind(path).value
        raise InputError(f"{path}: expected {FORMS}, found {found}{unpacking(path)}")
    try:
        if path.is_dir():
            return _open_folder(path)
        is_mcap = path.suffix == ".mcap" or file_kind(path) is FileKind.MCAP
        session = McapSession(path, [path], {}) if is_mcap else _open_bag(path)
        if parts := _other_parts(path):
            session.warn(f"{path.name} is one of {len(parts) + 1} parts; name the folder {path.parent} for all")
        return session
    except OSError as error:
        raise InputError(f"{path}: expected a readable recording; {error.strerror or error}") from None


def _other_parts(path: Path) -> list[Path]:
    """Files of a folder whose names differ from that of a part by its last number alone."""
    stem, _, number = path.stem.rpartition("_")
    others = path.parent.glob(f"[!.]*{path.suffix}") if number.isdigit() else ()
    return [p for p in others if p != path and re.fullmatch(re.escape(stem) + r"_\d+", p.stem)]


def session_info(path: str | Path) -> SessionInfo:
    """Topics, types, counts, time and metadata of a recording."""
    with open_session(path) as session:
        return session.info


def _open_bag(path: Path) -> Session:
    bases = sorted(path.glob("[!.]*.db3")) if path.is_dir() else [path] * (file_kind(path) is FileKind.SQLITE)
    try:
        if any(map(journal_of, bases)):  # the library reads none
            return SqliteScan(path, bases, "its journal holds messages, as after a crash: read row by row")
        return RosbagsSession(path)
    except InputError:
        if bases:
            return SqliteScan(path, bases)
        if path.is_dir():
            raise
        if file_kind(path) is not FileKind.ROSBAG1:
            raise
        return BagScan(path)


def _open_folder(path: Path) -> Session:
    description, warnings = read_metadata(path)
    storage = description.get("storage_identifier", "")
    files = storage_files(path, description)
    if not description and not any(p.suffix in _SUFFIXES for p in path.glob("[!.]*")):
        raise InputError(f"{path}: expected a usable {METADATA_FILE} of compressed files, found none; unpack: zstd -d")
    session: Session
    if files and storage in ("mcap", "") and all(f.suffix == ".mcap" for f in files):
        session = McapSession(path, files, custom_metadata(description))
    else:
        session = _open_bag(path)
    session.warnings += warnings
    return session
