"""An MCAP file as a stream of messages, read from front to back up to its damage.

The summary at the end serves for counts only: a file without one (after a crash) is read like any other.  Damaged
chunks are skipped and counted; sizes are checked before unpacking.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import IO, Any, NamedTuple

from drocap_ros.errors import InputError

logger = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
_MAX_CHUNK = 512 << 20
_FREE_EXPANSION = 64 << 20
_MAX_EXPANSION = 1000
_SEARCH = 1 << 20
_CHUNK_OPCODE = 6
#: opcode, length, start and end time, unpacked size, checksum, length of the compression's name
_CHUNK_HEAD = struct.Struct("<BQQQQII")
_COMPRESSION = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")


class DamageKind(Enum):
    """Kind of a damage; the value is its text with the fields of :class:`Damage`."""

    CUT_OFF = "cut off or damaged at byte {offset} of {amount}"
    SKIPPED_BYTES = "{amount} bytes skipped at byte {offset}"
    DAMAGED_CHUNKS = "{amount} damaged chunks"
    UNKNOWN_CHANNELS = "{amount} messages of unknown channels"
    NO_SUMMARY = "no summary at the end"
    NO_MESSAGE = "no message in it"


#: Damages behind or in which other tools may find more data.
_RECOVERABLE = frozenset({DamageKind.SKIPPED_BYTES, DamageKind.DAMAGED_CHUNKS, DamageKind.UNKNOWN_CHANNELS})


class Damage(NamedTuple):
    """One damage of a file.

    offset : byte at which it starts, where known
    amount : bytes, chunks or messages, by kind; CUT_OFF: size of the file
    """

    kind: DamageKind
    offset: int = 0
    amount: int = 0

    @property
    def keeps_data(self) -> bool:
        """Whether the damaged file may hold more data than was read."""
        return self.kind in _RECOVERABLE

    def __str__(self) -> str:
        return self.kind.value.format(offset=self.offset, amount=self.amount)


class McapChannel(NamedTuple):
    """One channel with its schema."""

    topic: str
    type_name: str
    message_encoding: str
    schema_encoding: str
    schema: str
    raw_type_name: str = ""
    metadata: tuple[tuple[str, str], ...] = ()


class McapMessage(NamedTuple):
    """One message as it is stored."""

    channel: McapChannel
    log_time_ns: int
    data: bytes
    publish_time_ns: int = 0
    sequence: int = 0


class _BoundedFile:
    """A file that limits reads to its size: a wrong length in a damaged file must not take memory."""

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

    profile : of the header, once messages are read: "ros2", "ros1" or another
    resync : after damage, search the next whole chunk instead of ending there
    damage : parts that could not be read so far
    """

    path: Path
    resync: bool = False
    damage: list[Damage] = field(default_factory=list)
    profile: str = "ros2"
    _whole_until: int = 0
    _metadata: dict[str, dict[str, str]] = field(default_factory=dict)

    def messages(self) -> Iterator[McapMessage]:
        """All messages in the order of the file.

        Raises
        ------
        InputError
            When the file is no MCAP or cannot be opened.
        """
        from mcap.records import Channel, Header, Message, Metadata, Schema

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
                yield McapMessage(channel, record.log_time, record.data, record.publish_time, record.sequence)
            elif isinstance(record, Header):
                self.profile = record.profile
            elif isinstance(record, Metadata):
                self._metadata.setdefault(record.name, {}).update(record.metadata)
        if lost:
            self.damage.append(Damage(DamageKind.UNKNOWN_CHANNELS, amount=lost))

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
        except Exception:  # noqa: BLE001  # a damaged summary fails in many ways; the stream does without
            return None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name, those of one name merged; without a summary those passed by :meth:`messages`."""
        from mcap.reader import SeekingReader

        if self.summary() is None:
            return self._metadata
        found: dict[str, dict[str, str]] = {}
        try:
            with self.path.open("rb") as file:
                bounded: Any = _BoundedFile(file)
                for record in SeekingReader(bounded, record_size_limit=bounded.size).iter_metadata():
                    found.setdefault(record.name, {}).update(record.metadata)
        except Exception:  # noqa: BLE001  # messages can be read without metadata
            logger.debug("%s: metadata cannot be read", self.path)
        return found

    def _records(self) -> Iterator[Any]:
        from mcap.records import Chunk
        from mcap.stream_reader import breakup_chunk

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
            bad_chunks = 0
            for record in self._raw_records(bounded, file):
                if not isinstance(record, Chunk):
                    yield record
                    continue
                try:
                    records = breakup_chunk(_unpacked(record), validate_crc=True)
                except Exception:  # noqa: BLE001  # decompression, checksum, lengths: a damaged chunk fails in many ways
                    bad_chunks += 1
                    continue
                yield from records
            if bad_chunks:
                self.damage.append(Damage(DamageKind.DAMAGED_CHUNKS, amount=bad_chunks))

    def _raw_records(self, bounded: Any, file: IO[bytes]) -> Iterator[Any]:
        from mcap.stream_reader import StreamReader

        skip = False
        while True:
            reader = StreamReader(bounded, skip_magic=skip, emit_chunks=True, record_size_limit=bounded.size)
            known = len(self.damage)
            yield from self._until_damaged(iter(reader.records), file, bounded.size)
            if not self.resync or len(self.damage) == known:
                return
            place = _next_chunk(file, self._whole_until + 1)
            if place is None:
                return
            self.damage[-1] = Damage(DamageKind.SKIPPED_BYTES, self._whole_until, place - self._whole_until)
            file.seek(place)
            skip = True

    def _until_damaged(self, records: Iterator[Any], file: IO[bytes], size: int) -> Iterator[Any]:
        from mcap.records import Footer

        ended, place = False, file.tell()
        while True:
            self._whole_until = place
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception:  # noqa: BLE001  # mcap raises many kinds on cut or damaged records
                if not ended:
                    self.damage.append(Damage(DamageKind.CUT_OFF, place, size))
                return
            ended = ended or isinstance(record, Footer)
            place = file.tell()
            yield record


def _next_chunk(file: IO[bytes], start: int) -> int | None:
    """Offset of the next record at or after ``start`` that has the form of a chunk and fits into the file."""
    size = file.seek(0, 2)
    overlap = _CHUNK_HEAD.size
    place = start
    while place < size - overlap:
        file.seek(place)
        data = file.read(_SEARCH + overlap)
        for match in _COMPRESSION.finditer(data):
            at = match.start() - _CHUNK_HEAD.size + 4
            if at < 0 or data[at] != _CHUNK_OPCODE:
                continue
            _, length, begin, end, unpacked, _, _ = _CHUNK_HEAD.unpack_from(data, at)
            if place + at + 9 + length <= size and begin <= end and unpacked <= _MAX_CHUNK:
                return place + at
        place += _SEARCH
    return None


def counted_channels(summary: Any) -> Iterator[tuple[McapChannel, int]]:
    """Channels of a summary with their numbers of messages."""
    for number, record in summary.channels.items():
        channel = _channel(record, summary.schemas.get(record.schema_id))
        yield channel, summary.statistics.channel_message_counts.get(number, 0)


def _channel(record: Any, schema: Any | None) -> McapChannel:
    text = schema.data.decode("utf-8", "replace") if schema is not None else ""
    return McapChannel(
        topic=record.topic,
        type_name=_ros2_name(schema.name) if schema is not None else "",
        message_encoding=record.message_encoding,
        schema_encoding=schema.encoding if schema is not None else "",
        schema=text,
        raw_type_name=schema.name if schema is not None else "",
        metadata=tuple(sorted(record.metadata.items())),
    )


def _ros2_name(name: str) -> str:
    """``package/Name`` (ROS 1, some writers) -> ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _unpacked(chunk: Any) -> Any:
    """The chunk with its records uncompressed; implausible sizes raise."""
    size = chunk.uncompressed_size
    if size > _MAX_CHUNK or size > max(_FREE_EXPANSION, _MAX_EXPANSION * len(chunk.data)):
        raise ValueError("chunk too large")
    if chunk.compression == "zstd":
        import zstandard

        declared = zstandard.get_frame_parameters(chunk.data).content_size
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError("chunk of two sizes")
        data = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise ValueError("unknown compression")
    if len(data) != size:
        raise ValueError("chunk of two sizes")
    return replace(chunk, compression="", data=data)
