"""An MCAP file as a stream of messages, read from front to back up to its damage.

The summary at the end serves for counts only: a file without one (after a crash) is read like any other.  Damaged
chunks are skipped and counted; sizes are checked before unpacking.
"""

from __future__ import annotations

import io
import logging
import re
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Schema
    from mcap.summary import Summary

logger = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
#: Largest chunk that is unpacked, and how much larger than packed one may be, beyond a size that is harmless anyway.
_MAX_CHUNK = 512 << 20
_FREE_EXPANSION = 64 << 20  # bytes
#: Bytes searched at once for the next chunk.
_SEARCH = 1 << 20
#: opcode, length, start and end time, unpacked size, checksum, length of the compression's name
_CHUNK_HEAD = struct.Struct("<BQQQQII")
_COMPRESSION = re.compile(rb"\x04\x00\x00\x00zstd|\x03\x00\x00\x00lz4")


class DamageKind(Enum):
    """Kind of a damage; the value is its text with the fields of :class:`Damage`."""

    CUT_OFF = "cut off or damaged at byte {offset} of {amount}"
    SKIPPED_BYTES = "{amount} bytes skipped at byte {offset}"
    DAMAGED_CHUNKS = "{amount} damaged chunks"
    UNKNOWN_CHANNELS = "{amount} messages of unknown channels"
    DECLARATIONS = "{amount} topics or types that are declared in two ways"
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


class _BoundedFile(io.BufferedReader):
    """A file that limits reads to its size: a wrong length in a damaged file must not take memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self.size = self.seek(0, 2)
        self.seek(0)

    def read(self, size: int | None = -1, /) -> bytes:
        rest = max(self.size - self.tell(), 0)
        return super().read(rest if size is None or size < 0 else min(size, rest))


@dataclass
class McapStream:
    """Reads one file; see the module's text.

    profile : of the header, once messages are read: "ros2", "ros1" or another
    resync : after damage, search the next whole chunk instead of ending there
    trusting : only there, and take declarations of channels as they come: no file is read twice that is whole
    damage : parts that could not be read so far
    """

    path: Path
    resync: bool = False
    trusting: bool = False
    damage: list[Damage] = field(default_factory=list)
    profile: str = "ros2"
    _whole_until: int = 0
    _metadata: dict[str, dict[str, str]] = field(default_factory=dict)

    def messages(self) -> Iterator[McapMessage]:
        """All messages in the order of the file."""
        from mcap.records import Channel, Header, Message, Metadata, Schema

        schemas: dict[int, Schema] = {}
        searched = self.resync and not self.trusting
        channels, lost = self._declared() if searched else {}, 0
        for record in self._records():
            if isinstance(record, Schema):
                schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                channels.setdefault(record.id, _channel(record, schemas.get(record.schema_id)))
            elif isinstance(record, Message):
                if record.channel_id not in channels and not searched:
                    channels, searched = self._declared() | channels, True
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

    def _declared(self) -> dict[int, McapChannel]:
        """Channels by what most of their declarations in the file say: damage may have hit some of them."""
        from mcap.records import Channel, Schema

        said: dict[tuple[type, int], Counter[str]] = defaultdict(Counter)
        records: dict[str, McapRecord] = {}
        summary = self.summary()
        last = [] if summary is None else [*summary.schemas.values(), *summary.channels.values()]
        for record in chain(McapStream(self.path, resync=True)._records(), last):
            if isinstance(record, Schema | Channel):
                values = {name: sorted(v.items()) if isinstance(v, dict) else v for name, v in vars(record).items()}
                said[type(record), record.id][text := repr(values)] += 1
                records[text] = record
        if differ := sum(len(texts) > 1 for texts in said.values()):
            self.damage.append(Damage(DamageKind.DECLARATIONS, amount=differ))
        most = {of: records[texts.most_common(1)[0][0]] for of, texts in said.items()}
        return {
            record.id: _channel(record, most.get((Schema, record.schema_id)))  # type: ignore[arg-type]
            for record in most.values()
            if isinstance(record, Channel)
        }

    def summary(self) -> Summary | None:
        """The file's own summary, or None where there is no usable one."""
        from mcap.reader import SeekingReader

        try:
            with _BoundedFile(self.path) as file:
                file.seek(-len(MAGIC), 2)
                if file.read() != MAGIC:
                    return None
                file.seek(0)
                return SeekingReader(file, record_size_limit=file.size).get_summary()
        except Exception:  # noqa: BLE001  # a damaged summary fails in many ways; the stream does without
            return None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name, those of one name merged; without a summary those passed by :meth:`messages`."""
        from mcap.reader import SeekingReader

        if self.summary() is None:
            return self._metadata
        found: dict[str, dict[str, str]] = {}
        try:
            with _BoundedFile(self.path) as file:
                for record in SeekingReader(file, record_size_limit=file.size).iter_metadata():
                    found.setdefault(record.name, {}).update(record.metadata)
        except Exception:  # noqa: BLE001  # messages can be read without metadata
            logger.debug("%s: metadata cannot be read", self.path)
        return found

    def _records(self) -> Iterator[McapRecord]:
        """Records of the file and of its whole chunks."""
        from mcap.records import Chunk
        from mcap.stream_reader import breakup_chunk

        try:
            file = _BoundedFile(self.path)
        except OSError as error:
            raise InputError(f"{self.path}: expected a readable file; {error.strerror}") from None
        with file:
            magic, bad_chunks = file.read(len(MAGIC)), 0
            if magic != MAGIC and not (self.resync and _few_bits_apart(magic, MAGIC)):
                raise InputError(
                    f"{self.path}: expected an MCAP file, found other content at its start; check the file"
                )
            place: int | None = file.tell()
            while place is not None:
                begin, place = place, None
                for record, start, end in self._until_damaged(file, begin):
                    whole = False
                    if isinstance(record, Chunk):
                        try:
                            records = breakup_chunk(_unpacked(record), validate_crc=True)
                            whole = True
                        except Exception:  # noqa: BLE001  # decompression, checksum, lengths: a chunk fails in many ways
                            bad_chunks += 1
                            records = []
                        yield from records
                    else:
                        yield record
                    # A wrong length swallows the chunks behind it.
                    suspicious = not whole and (isinstance(record, Chunk) or not self.trusting)
                    if self.resync and suspicious and (place := _next_chunk(file, start + 1, end)) is not None:
                        break
                    file.seek(end)
                else:
                    place = self._behind_damage(file)
            if bad_chunks:
                self.damage.append(Damage(DamageKind.DAMAGED_CHUNKS, amount=bad_chunks))

    def _behind_damage(self, file: _BoundedFile) -> int | None:
        """Where the next chunk is, behind the record at which reading ended; None = nowhere, or nothing was damaged."""
        if (
            not self.resync
            or not self.damage
            or self.damage[-1] != Damage(DamageKind.CUT_OFF, self._whole_until, file.size)
        ):
            return None
        place = _next_chunk(file, self._whole_until + 1, file.size)
        if place is not None:
            self.damage[-1] = Damage(DamageKind.SKIPPED_BYTES, self._whole_until, place - self._whole_until)
        return place

    def _until_damaged(self, file: _BoundedFile, place: int) -> Iterator[tuple[McapRecord, int, int]]:
        """Records from a place on, with the places of their first byte and of that behind them."""
        from mcap.records import Footer
        from mcap.stream_reader import StreamReader

        file.seek(place)
        records = iter(StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=file.size).records)
        while True:
            self._whole_until = place
            try:
                record = next(records)
            except StopIteration:
                return
            except Exception:  # noqa: BLE001  # mcap raises many kinds on cut or damaged records
                self.damage.append(Damage(DamageKind.CUT_OFF, place, file.size))
                return
            start, place = place, file.tell()
            if isinstance(record, Footer):
                if file.size - place > len(MAGIC):  # it is none: the end of a file follows
                    self.damage.append(Damage(DamageKind.CUT_OFF, start, file.size))
                return
            yield record, start, place


def _few_bits_apart(found: bytes, expected: bytes) -> bool:
    """Whether bytes are the expected ones but for up to three bits: damaged, and no other format."""
    return len(found) == len(expected) and sum((a ^ b).bit_count() for a, b in zip(found, expected, strict=True)) <= 3


def _next_chunk(file: IO[bytes], start: int, stop: int) -> int | None:
    """Offset of the first record in [start, stop) that has the form of a chunk and fits into the file."""
    size = file.seek(0, 2)
    overlap = _CHUNK_HEAD.size
    place = start
    while place < min(stop, size - overlap):
        file.seek(place)
        data = file.read(min(_SEARCH, stop - place) + overlap)
        for match in _COMPRESSION.finditer(data):
            at = match.start() - _CHUNK_HEAD.size + 4
            # MCAP's code of a chunk, https://mcap.dev/spec.
            if at < 0 or place + at >= stop or data[at] != 6:
                continue
            _, length, begin, end, unpacked, _, _ = _CHUNK_HEAD.unpack_from(data, at)
            if place + at + 9 + length <= size and begin <= end and unpacked <= _MAX_CHUNK:
                return place + at
        place += _SEARCH
    return None


def counted_channels(summary: Summary) -> Iterator[tuple[McapChannel, int]]:
    """Channels of a summary with their numbers of messages."""
    counts = summary.statistics.channel_message_counts if summary.statistics else {}
    for number, record in summary.channels.items():
        channel = _channel(record, summary.schemas.get(record.schema_id))
        yield channel, counts.get(number, 0)


def _channel(record: Channel, schema: Schema | None) -> McapChannel:
    name, encoding, data = (schema.name, schema.encoding, schema.data) if schema is not None else ("", "", b"")
    text, metadata = data.decode("utf-8", "replace"), tuple(sorted(record.metadata.items()))
    return McapChannel(record.topic, _ros2_name(name), record.message_encoding, encoding, text, name, metadata)


def _ros2_name(name: str) -> str:
    """``package/Name`` (ROS 1, some writers) -> ``package/msg/Name``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk with its records uncompressed; implausible sizes raise."""
    size = chunk.uncompressed_size
    # What is packed more and is large is no recording; a judgement.
    if size > _MAX_CHUNK or size > max(_FREE_EXPANSION, 1000 * len(chunk.data)):
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
