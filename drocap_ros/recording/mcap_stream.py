"""An MCAP file as a stream of messages: read from front to back, and as far as it can be read.

The summary at the end is used for counts only, so that a file without one (cut off by a crash) is read like any
other.  Damaged chunks are skipped and counted; sizes are checked before anything is unpacked.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

from drocap_ros.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
_MAX_CHUNK = 512 << 20
_FREE_EXPANSION = 64 << 20
_MAX_EXPANSION = 1000


class McapChannel(NamedTuple):
    """One channel with its schema."""

    topic: str
    type_name: str
    message_encoding: str
    schema_encoding: str
    schema: str


class McapMessage(NamedTuple):
    """One message as it is stored."""

    channel: McapChannel
    log_time_ns: int
    data: bytes


class _BoundedFile:
    """A file of which no more can be asked than is there: a length that lies must not take memory."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.size = file.seek(0, 2)
        file.seek(0)
        self.tell, self.seek = file.tell, file.seek

    def read(self, size: int = -1) -> bytes:
        rest = max(self.size - self._file.tell(), 0)
        return self._file.read(rest if size < 0 else min(size, rest))


@dataclass
class McapStream:
    """Reads one file; see the module's text.

    damage : in words, what could not be read so far
    """

    path: Path
    damage: list[str] = field(default_factory=list)

    def messages(self) -> Iterator[McapMessage]:
        """All messages in the order of the file.

        Raises
        ------
        InputError
            When the file is no MCAP or cannot be opened.
        """
        from mcap.records import Channel, Message, Schema

        schemas: dict[int, Any] = {}
        channels: dict[int, McapChannel] = {}
        lost = 0
        for record in self._records():
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = _channel(record, schemas.get(record.schema_id))
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    lost += 1
                    continue
                yield McapMessage(channel, record.log_time, record.data)
        if lost:
            self.damage.append(f"{lost} messages of unknown channels")

    def summary(self) -> Any | None:
        """The file's own summary (mcap's ``Summary``), or None where there is no usable one."""
        from mcap.reader import SeekingReader

        try:
            with self.path.open("rb") as file:
                bounded: Any = _BoundedFile(file)
                file.seek(-len(MAGIC), 2)
                if file.read() != MAGIC:
                    return None
                file.seek(0)
                return SeekingReader(bounded, record_size_limit=bounded.size).get_summary()
        except Exception:  # a damaged summary raises all kinds; the stream itself is the truth
            return None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name, from a file with a usable summary."""
        from mcap.reader import SeekingReader

        try:
            with self.path.open("rb") as file:
                bounded: Any = _BoundedFile(file)
                reader = SeekingReader(bounded, record_size_limit=bounded.size)
                return {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        except Exception:
            return {}

    def _records(self) -> Iterator[Any]:
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        try:
            file = self.path.open("rb")
        except OSError as error:
            raise InputError(f"{self.path}: expected a readable file; {error.strerror}") from None
        with file:
            bounded: Any = _BoundedFile(file)
            if bounded.read(len(MAGIC)) != MAGIC:
                raise InputError(
                    f"{self.path}: expected an MCAP file, found other content at its start; check the path"
                )
            file.seek(0)
            reader = StreamReader(bounded, emit_chunks=True, record_size_limit=bounded.size)
            bad_chunks = 0
            for record in self._until_damaged(iter(reader.records), file, bounded.size):
                if not isinstance(record, Chunk):
                    yield record
                    continue
                try:
                    records = breakup_chunk(_unpacked(record), validate_crc=True)
                except Exception:  # decompression, checksum, lengths: a damaged chunk fails in many ways
                    bad_chunks += 1
                    continue
                yield from records
            if bad_chunks:
                self.damage.append(f"{bad_chunks} damaged chunks")

    def _until_damaged(self, records: Iterator[Any], file: IO[bytes], size: int) -> Iterator[Any]:
        from mcap.records import Footer

        ended, place = False, 0
        while True:
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception:  # mcap raises many kinds on cut or damaged records
                if not ended:
                    self.damage.append(f"cut off or damaged at byte {place} of {size}")
                return
            ended = ended or isinstance(record, Footer)
            place = file.tell()
            yield record


def _channel(record: Any, schema: Any | None) -> McapChannel:
    text = schema.data.decode("utf-8", "replace") if schema is not None else ""
    return McapChannel(
        topic=record.topic,
        type_name=_ros2_name(schema.name) if schema is not None else "",
        message_encoding=record.message_encoding,
        schema_encoding=schema.encoding if schema is not None else "",
        schema=text,
    )


def _ros2_name(name: str) -> str:
    """``package/Name`` (ROS 1, some writers) -> ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _unpacked(chunk: Any) -> Any:
    """The chunk with its records uncompressed; refuses sizes that no honest file has."""
    import dataclasses

    size = chunk.uncompressed_size
    if size > _MAX_CHUNK or size > max(_FREE_EXPANSION, _MAX_EXPANSION * len(chunk.data)):
        raise ValueError("chunk too large")
    if chunk.compression == "zstd":
        import zstandard

        told = zstandard.get_frame_parameters(chunk.data).content_size
        if told not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("chunk of two sizes")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise struct.error("unknown compression")
    if len(data) != size:
        raise ValueError("chunk of two sizes")
    return dataclasses.replace(chunk, compression="", data=data)
