"""Bags that the library for whole ones does not open: rosbag1 without an index or damaged, damaged sqlite3."""

from __future__ import annotations

import contextlib
import io
import re
import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

from drocap_ros.errors import InputError, first_line
from drocap_ros.recording.mcap.metadata import standard_types, types_of
from drocap_ros.recording.session import Message, RawMessage, Session, SessionInfo, unpacked

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

#: Largest record, bytes: an image of 8000x6000 px and more; a longer one is damage.
_MAX_RECORD = 1 << 29
#: Longest header of a record, and bytes of a search for one, whose fields begin so.
_LONGEST_HEADER, _BLOCK, _OP = 512, 1 << 20, re.compile(rb"\x04\0\0\0op=[\x02\x05\x07]")
#: Rows of a damaged table that are read at once, and the least bytes of one.
_AT_ONCE, _LEAST_ROW = 64, 40
_BY_ID = "SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ? ORDER BY id"
#: Kinds of records.
_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"


class _Connection(NamedTuple):
    topic: str
    type_name: str
    definition: str


class BagScan(Session):
    """Reads records one by one; what follows damage is left out with a warning."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._stores: dict[_Connection, Typestore] = {}
        if not self.info.topics:
            raise InputError(f"{path}: expected a rosbag1 recording, version 2.0, with messages, found none; check it")
        self.warn("the bag has no usable index, as after a crash: read message by message")

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of the file."""
        connections: dict[bytes, _Connection] = {}
        with self.path.open("rb") as file:
            file.readline(64)
            for header, content in self._records(file):
                number = header.get("conn", b"")
                if isinstance(content, _Connection):
                    connections[number] = content
                elif header["op"] == _MESSAGE and number in connections:
                    found = connections[number]
                    if not topics or found.topic in topics:
                        yield RawMessage(found.topic, found.type_name, _time(header), content, found)

    def decode(self, raw: RawMessage) -> Message:
        """The message as an object with the fields of its definition."""
        connection = raw.source
        assert isinstance(connection, _Connection)
        store = self._stores.get(connection)
        if store is None:
            store = self._stores[connection] = types_of(connection.type_name, connection.definition)
        return store.deserialize_ros1(raw.data, raw.type_name)

    def _records(self, file: BinaryIO) -> Iterator[tuple[dict[str, bytes], bytes | _Connection]]:
        """Headers and content of the records of a file, and of the chunks in it; damage is passed over."""
        from rosbags.rosbag1.reader import Header, decompressors, read_bytes, read_uint32

        while file.read(1):
            place = file.seek(-1, io.SEEK_CUR)
            try:
                header = Header.read(file)
                kind, length = header["op"], read_uint32(file)
                if length > _MAX_RECORD:
                    raise InputError(f"{length} bytes in a record")
                content = file.read(length) if kind == _CHUNK else read_bytes(file, length)
                if kind == _CHUNK:  # the last one may be cut off
                    content = decompressors[header.get_string("compression")](content)
                connection = _connection(header, content) if kind == _CONNECTION else None
            except Exception as error:  # noqa: BLE001  # of the reader and of two decompressors
                self.warn(f"cut off or damaged at byte {place}: {first_line(error)}; messages about it are missing")
                following = _next_record(file, place + 1)
                if following is None:
                    return
                file.seek(following)
                continue
            if kind == _CHUNK:
                yield from self._records(io.BytesIO(content))
            else:
                yield header, connection or content

    def _read_info(self) -> SessionInfo:
        return self._counted("rosbag (.bag) without index")


def _next_record(file: BinaryIO, place: int) -> int | None:
    """Place of the next record of a message, connection or chunk, by its header; None where none follows."""
    while True:
        file.seek(place)
        data = file.read(_BLOCK)
        for found in _OP.finditer(data):
            for at in range(found.start() - 4, max(found.start() - _LONGEST_HEADER, -1), -1):
                if _is_header(data, at):
                    return place + at
        if len(data) < _BLOCK:
            return None
        place += _BLOCK - _LONGEST_HEADER


def _is_header(data: bytes, at: int) -> bool:
    """Whether a header's length and fields, each with its own length, stand at a place."""
    end = at + 4 + int.from_bytes(data[at : at + 4], "little")
    at += 4
    if not at < end <= min(len(data), at + _LONGEST_HEADER):
        return False
    while at < end:
        length = int.from_bytes(data[at : at + 4], "little")
        if b"=" not in data[at + 4 : at + 4 + min(length, 16)]:
            return False
        at += 4 + length
    return at == end


class SqliteScan(Session):
    """Reads ``.db3`` files row by row, with their journals; rows that cannot be read are left out with a warning."""

    def __init__(self, path: Path, files: list[Path], why: str = "") -> None:
        super().__init__(path)
        self._files = files
        self._stores: dict[tuple[str, str], Typestore] = {}
        if not self.info.topics:
            raise InputError(
                f"{path}: expected a rosbag2 recording with messages, found none that can be read; check it"
            )
        self.warn(why or "the recording is damaged: read row by row, those about the damage are missing")

    def raw_messages(self, topics: Collection[str] = ()) -> Iterator[RawMessage]:
        """Messages of some topics (default: all) in the order of the files."""
        for file in self._files:
            how = "mode=ro" if journal_of(file) else "mode=ro&immutable=1"
            with contextlib.closing(sqlite3.connect(f"{file.absolute().as_uri()}?{how}", uri=True)) as base:
                known = {row[0]: (row[1], row[2]) for row in _rows_of(base, "SELECT id, name, type FROM topics")}
                texts = dict(_rows_of(base, "SELECT topic_type, encoded_message_definition FROM message_definitions"))
                last, most = next(_rows_of(base, "SELECT max(id) FROM messages"), (None,))[0], file.stat().st_size
                stack = [(1, min(last or most, most // _LEAST_ROW))]  # a damaged number of a row may be any
                while stack:
                    first, end = stack.pop()
                    try:
                        found = base.execute(_BY_ID, (first, end)).fetchall() if end - first < _AT_ONCE else None
                    except sqlite3.DatabaseError:
                        found = None if end > first else []
                    if found is None:
                        middle = (first + end) // 2
                        stack += [(middle + 1, end), (first, middle)]
                    for topic_id, log_time_ns, data in found or ():
                        name, kind = known.get(topic_id, ("", ""))
                        if name and isinstance(data, bytes) and (not topics or name in topics):
                            yield RawMessage(name, kind, int(log_time_ns), unpacked(data), texts.get(kind, ""))

    def decode(self, raw: RawMessage) -> Message:
        """The message as an object with the fields of its definition."""
        kind, text = raw.type_name, str(raw.source)
        if (kind, text) not in self._stores:
            self._stores[kind, text] = types_of(kind, text) if text else standard_types()
        return self._stores[kind, text].deserialize_cdr(raw.data, kind)

    def _read_info(self) -> SessionInfo:
        return self._counted("rosbag2, SQLite")


def journal_of(file: Path) -> bool:
    """Whether messages of a ``.db3`` are still in the journal beside it, as after a crash of the recorder."""
    journal = file.with_name(f"{file.name}-wal")
    return journal.is_file() and journal.stat().st_size > 0


def _rows_of(base: sqlite3.Connection, words: str) -> Iterator[tuple[Any, ...]]:
    with contextlib.suppress(sqlite3.DatabaseError):  # a table is missing, or damaged
        yield from base.execute(words)


def _connection(header: dict[str, bytes], data: bytes) -> _Connection:
    from rosbags.rosbag1.reader import Header
    from rosbags.typesys.msg import normalize_msgtype

    more = Header.read(io.BytesIO(len(data).to_bytes(4, "little") + data))
    definition = more.get_string("message_definition")
    return _Connection(header["topic"].decode(), normalize_msgtype(more.get_string("type")), definition)


def _time(header: dict[str, bytes]) -> int:
    """Time ns of a message, as it was recorded."""
    stamp = header.get("time", b"")
    return int.from_bytes(stamp[:4], "little") * 10**9 + int.from_bytes(stamp[4:], "little")
