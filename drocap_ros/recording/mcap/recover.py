"""Repairs a session after a crash or power cut, for every reader of MCAP and rosbag2.

Each damaged file is copied, the copy is read back and compared message by message, and only then it replaces the file;
``metadata.yaml`` is made from the files.  Where data in the middle of a file could not be read, the damaged file is
kept, named ``*.damaged``.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema

from drocap_ros import __version__
from drocap_ros.errors import InputError
from drocap_ros.recording.mcap import metadata as bag
from drocap_ros.recording.mcap.metadata import FileRecord, TopicRecord, dump_yaml, type_hash
from drocap_ros.recording.mcap.stream import MAGIC, Damage, DamageKind, McapChannel, McapStream, counted_channels


class McapFile:
    """Writes messages of registered topics; threads, space and the folder are the caller's.

    topics : by name, with the number of their messages in this file
    record : the file's entry in ``metadata.yaml``

    Parameters
    ----------
    path : to create
    compression : "none", "lz4" or "zstd"
    chunk_bytes : a chunk that has grown to this size is closed

    Raises
    ------
    OSError
        When the file exists or cannot be written.
    """

    def __init__(
        self, path: Path, compression: str = "zstd", chunk_bytes: int = 1 << 20, profile: str = "ros2"
    ) -> None:
        from mcap.writer import CompressionType, Writer

        self.path = path
        self.topics: dict[str, TopicRecord] = {}
        self.record = FileRecord(path.name)
        self._in_open_chunk: Counter[str] = Counter()
        self._in_closed_chunks: Counter[str] = Counter()
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._declared: list[Schema | Channel] = []
        self._chunks = 0
        kinds = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
        self._file = CommittedFile(path)
        self._mcap = Writer(self._file, chunk_size=chunk_bytes, compression=kinds[compression])  # type: ignore[arg-type]
        self._mcap.start(profile, f"drocap_ros {__version__}; mcap {version('mcap')}")
        self._file.commit()

    @property
    def size(self) -> int:
        """Bytes so far, without the open chunk."""
        return self._file.tell()

    @property
    def pending(self) -> int:
        """Bytes of whole chunks that are not committed."""
        return self._file.pending

    def register(
        self,
        topic: TopicRecord,
        schema: str,
        *,
        encoding: str = "cdr",
        schema_encoding: str = "ros2msg",
        metadata: Mapping[str, str] | None = None,
        key: str = "",
    ) -> None:
        """Declare a topic before its first message; the counts of ``topic`` start from 0 in this file.

        ``key`` identifies it in :meth:`add`, by default its name.
        """
        kind = (topic.type_name, schema)
        if kind not in self._schemas:
            number = 0
            if schema or schema_encoding:
                data = schema.encode()
                number = self._mcap.register_schema(topic.type_name, schema_encoding, data)
                self._declared.append(Schema(id=number, data=data, encoding=schema_encoding, name=topic.type_name))
            self._schemas[kind] = number
        key, schema_id = key or topic.name, self._schemas[kind]
        values = dict(metadata) if metadata is not None else {"offered_qos_profiles": dump_yaml(topic.qos)}
        number = self._mcap.register_channel(topic.name, encoding, schema_id, values)
        self._channels[key] = number
        self._declared.append(
            Channel(id=number, message_encoding=encoding, metadata=values, schema_id=schema_id, topic=topic.name)
        )
        self.topics[key] = TopicRecord(topic.name, topic.type_name, topic.type_hash, topic.qos)

    def add(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int, sequence: int) -> None:
        """Append one serialized message."""
        before = self._file.tell()
        self._mcap.add_message(
            self._channels[topic],
            log_time=log_time_ns,
            data=data,
            publish_time=publish_time_ns,
            sequence=sequence & 0xFFFFFFFF,
        )
        self.topics[topic].count += 1
        self.record.count(log_time_ns)
        self._in_open_chunk[topic] += 1
        if self._file.tell() != before:
            self._chunk_closed()

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record."""
        self._mcap.add_metadata(name, dict(values))

    def save(self, sync: bool) -> None:
        """Close the open chunk and commit all chunks; an OSError leaves the file at the last commit."""
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap has no types here
        self._chunk_closed()
        self.commit(sync)

    def commit(self, sync: bool = False) -> None:
        """Commit the whole chunks; errors as :meth:`save`."""
        self._file.commit(sync)
        self._in_closed_chunks.clear()

    def finish(self, sync: bool) -> None:
        """Write the summary and close; errors as :meth:`save`."""
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap has no types here
        self._chunk_closed()
        self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap has no types here
        self.commit(sync)
        self._file.close()

    def abandon(self) -> Counter[str]:
        """Close without the open chunk; returns the lost messages by topic and subtracts them from the counts."""
        self._file.close()
        lost = self._in_open_chunk + self._in_closed_chunks
        for topic, count in lost.items():
            self.topics[topic].count -= count
        self.record.messages -= lost.total()
        return lost

    def _chunk_closed(self) -> None:
        if not self._in_open_chunk:
            return
        self._in_closed_chunks += self._in_open_chunk
        self._in_open_chunk.clear()
        self._chunks += 1
        if self._chunks & (self._chunks - 1) == 0:
            # The library declares channels in the first chunk alone: without it no message would be known.  Behind
            # every first, second, fourth chunk and so on they stand again.
            builder = RecordBuilder()
            for record in self._declared:
                record.write(builder)
            self._file.write(builder.end())  # type: ignore[no-untyped-call]  # mcap has no types here


class CommittedFile:
    """Output stream of the MCAP writer.

    ``write`` collects; ``commit`` writes the collected bytes.  If that fails (disk full), the file is cut back to the
    last commit: it never ends in half a chunk.

    Raises
    ------
    FileExistsError
        At construction, when the file exists.
    """

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._pending = bytearray()
        self._committed = 0

    def write(self, data: bytes) -> int:
        """Collect."""
        self._pending += data
        return len(data)

    def tell(self) -> int:
        """Offset of the next byte, collected bytes included."""
        return self._committed + len(self._pending)

    def flush(self) -> None:
        """No effect, see :meth:`commit`; the MCAP writer calls it."""

    @property
    def pending(self) -> int:
        """Bytes collected and not yet committed."""
        return len(self._pending)

    def commit(self, sync: bool = False) -> None:
        """Write the collected bytes; ``sync`` forces them to the disk.

        Raises
        ------
        OSError
            When they cannot be written; the file then ends at the last commit.
        """
        view = memoryview(bytes(self._pending))
        self._pending.clear()
        try:
            place = 0
            while place < len(view):
                place += os.write(self._fd, view[place:])
            if sync:
                os.fdatasync(self._fd)
        except OSError:
            os.ftruncate(self._fd, self._committed)
            os.lseek(self._fd, self._committed, os.SEEK_SET)
            raise
        self._committed += len(view)

    def close(self) -> None:
        """Close; bytes that are not committed are lost."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


_BESIDE = ".recovering"

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class RecoveredFile:
    """Result for one file.

    repaired : False = it was whole and is unchanged
    messages : in it, each read back
    damage : parts that could not be read
    kept : the damaged file, where data in its middle could not be read
    """

    path: Path
    repaired: bool
    messages: int
    damage: tuple[Damage, ...]
    kept: Path | None = None


def recover_session(path: str | Path, progress: Progress | None = None) -> list[RecoveredFile]:
    """Repair a session folder or a single ``.mcap`` in place."""
    path = Path(path)
    files, custom = _files(path)
    done = []
    topics: dict[str, TopicRecord] = {}
    records: list[FileRecord] = []
    try:
        for number, file in enumerate(files):
            if progress is not None:
                progress("files", number / len(files))
            done.append(_recover_file(file, len(files) > 1))
            records.append(_describe(file, topics))
            custom = McapStream(file).metadata().get(bag.METADATA_RECORD, {}) | custom
        if path.is_dir():
            ordered = [topics[name] for name in sorted(topics)]
            bag.write_atomically(path / bag.METADATA_FILE, bag.dump_yaml(bag.bag_metadata(records, ordered, custom)))
            for left in path.glob("*.tmp"):
                left.unlink()
    except OSError as error:
        raise InputError(
            f"{path}: expected space for a repaired copy; {error.strerror or error}; the session is unchanged: make"
            " room, or copy the session to another disk"
        ) from None
    if progress is not None:
        progress("files", 1.0)
    return done


def _files(path: Path) -> tuple[list[Path], dict[str, str]]:
    if not path.exists():
        raise InputError(f"{path}: expected a session folder or .mcap, found no such file; check the path")
    if not path.is_dir():
        if not path.is_file() or path.suffix != ".mcap":
            raise InputError(f"{path}: expected a session folder or .mcap, found another kind of file; check the path")
        return [path], {}
    description, _ = bag.read_metadata(path)
    files = bag.storage_files(path, description)
    if not files or any(file.suffix != ".mcap" for file in files):
        raise InputError(f"{path}: expected a session of MCAP files, found none or others; check the path")
    return files, bag.custom_metadata(description)


def _recover_file(path: Path, one_of_several: bool) -> RecoveredFile:
    beside = path.with_name(path.name + _BESIDE)
    beside.unlink(missing_ok=True)  # of an interrupted recovery
    stream = McapStream(path, resync=True)
    size = path.stat().st_size
    if size < len(MAGIC):
        if not one_of_several and size == 0:
            raise InputError(f"{path}: expected an MCAP file, found 0 bytes; there is nothing in it to repair")
        if not MAGIC.startswith(path.read_bytes()):
            raise InputError(f"{path}: expected an MCAP file, found other content at its start; check the path")
        return _replace(stream, beside, 0, (Damage(DamageKind.NO_MESSAGE),))
    count = sum(1 for _ in stream.messages())
    damage = tuple(stream.damage)
    if not damage and _is_whole(stream, count):
        return RecoveredFile(path, False, count, ())
    return _replace(stream, beside, count, damage or (Damage(DamageKind.NO_SUMMARY),))


def _is_whole(stream: McapStream, count: int) -> bool:
    summary = stream.summary()
    return (
        summary is not None
        and summary.statistics is not None
        and summary.statistics.message_count == count
        and len(summary.chunk_indexes) == summary.statistics.chunk_count
    )


def _replace(stream: McapStream, beside: Path, count: int, damage: tuple[Damage, ...]) -> RecoveredFile:
    path = stream.path
    has_header = path.stat().st_size >= len(MAGIC)
    try:
        if has_header:
            _copy(stream, beside)
        else:
            McapFile(beside).finish(sync=True)
        copy = McapStream(beside)
        pairs = itertools.zip_longest(stream.messages() if has_header else (), copy.messages())
        if not all(old == new for old, new in pairs) or copy.damage or not _is_whole(copy, count):
            raise InputError(f"{path}: expected {count} equal messages in the repaired copy; the session is unchanged")
        kept = None
        if any(d.keeps_data for d in damage):
            kept = path.with_name(path.name + ".damaged")
            if not kept.exists():
                os.link(path, kept)
        os.replace(beside, path)
        bag.sync_folder(path.parent)
    finally:
        beside.unlink(missing_ok=True)
    return RecoveredFile(path, True, count, damage, kept)


def _copy(stream: McapStream, target: Path) -> None:
    file = McapFile(target, profile=stream.profile)
    keys: dict[McapChannel, str] = {}
    try:
        for name, values in stream.metadata().items():
            if name != "rosbag2":  # holds the counts of the damaged file
                file.add_metadata(name, values)
        for channel, log_ns, data, publish_ns, sequence in stream.messages():
            if channel not in keys:
                # Two channels of one topic (two publishers) stay separate.
                keys[channel] = channel.topic if channel.topic not in keys.values() else f"{channel.topic}#{len(keys)}"
                file.register(
                    TopicRecord(channel.topic, channel.raw_type_name, "", []),
                    channel.schema,
                    encoding=channel.message_encoding,
                    schema_encoding=channel.schema_encoding,
                    metadata=dict(channel.metadata),
                    key=keys[channel],
                )
            file.add(keys[channel], data, log_ns, publish_ns, sequence)
            if file.pending:
                file.commit()
        file.finish(sync=True)
    except OSError:
        file.abandon()
        raise


def _describe(path: Path, topics: dict[str, TopicRecord]) -> FileRecord:
    """Add the counts of a whole file to those of the session."""
    record = FileRecord(path.name)
    summary = McapStream(path).summary()
    if summary is None or summary.statistics is None:
        return record
    statistics = summary.statistics
    if statistics.message_count:
        record.start_ns, record.end_ns = statistics.message_start_time, statistics.message_end_time
        record.messages = statistics.message_count
    for channel, count in counted_channels(summary):
        kind = channel.raw_type_name
        if channel.topic not in topics:
            qos = _qos(dict(channel.metadata))
            topics[channel.topic] = TopicRecord(channel.topic, kind, type_hash(kind, channel.schema), qos)
        topics[channel.topic].count += count
    return record


def _qos(metadata: dict[str, str]) -> list[bag.Yaml]:
    import yaml

    try:
        profiles = yaml.safe_load(metadata.get("offered_qos_profiles", ""))
    except yaml.YAMLError:
        profiles = None
    return profiles if isinstance(profiles, list) and profiles else bag.qos_profile()
