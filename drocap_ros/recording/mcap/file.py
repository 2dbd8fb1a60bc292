"""One storage file of a session: an MCAP file that ends in whole chunks after every commit."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Schema

from drocap_ros import __version__
from drocap_ros.recording.mcap.metadata import FileRecord, TopicRecord, dump_yaml


class McapFile:
    """Writes messages of registered topics; threads, space and the folder are the caller's.

    topics : by name, with the number of their messages in this file
    record : the file's entry in ``metadata.yaml``

    path : to create
    compression : "none", "lz4" or "zstd"
    chunk_bytes : a chunk that has grown to this size is closed

    Raises OSError when the file exists or cannot be written.
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

    raises FileExistsError : at construction, when the file exists
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

        Raises OSError when they cannot be written; the file then ends at the last commit.
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
