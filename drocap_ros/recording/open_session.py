"""Opens a recording: ours, rosbag2's (MCAP or sqlite3), one ``.mcap`` or ``.bag``; bags without an index."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

from drocap_ros.errors import InputError, first_line
from drocap_ros.file_kind import RECORDINGS, FileKind, file_kind
from drocap_ros.recording.mcap.metadata import METADATA_FILE, custom_metadata, read_metadata, storage_files, types_of
from drocap_ros.recording.session import FORMS, Message, RawMessage, Session, SessionInfo
from drocap_ros.recording.session_readers import McapSession, RosbagsSession

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


#: Largest record, bytes: an image of 8000x6000 px and more; a longer one is damage.
_MAX_RECORD = 1 << 29
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
        """Headers and content of the records of a file, and of the chunks in it, up to the first damage."""
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
                self.warn(f"cut off or damaged at byte {place}: {first_line(error)}; read the messages before it")
                return
            if kind == _CHUNK:
                yield from self._records(io.BytesIO(content))
            else:
                yield header, connection or content

    def _read_info(self) -> SessionInfo:
        counts, times = Counter[tuple[str, str]](), list[int]()
        for message in self.raw_messages():
            counts[message.topic, message.type_name] += 1
            times = [min([*times, message.log_time_ns]), max([*times, message.log_time_ns])]
        return self._info_of("rosbag (.bag) without index", counts, times, {})


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


_SUFFIXES = (".mcap", ".bag", ".db3")
#: Ending of their files that are compressed as a whole.
_PACKED = ".zstd"


def is_recording(path: str | Path) -> bool:
    """Whether :func:`open_session` may read a path: by its first bytes, its name, or the names in a folder."""
    path = Path(path)
    if path.is_dir():
        return (path / METADATA_FILE).is_file() or any(p.suffix in (*_SUFFIXES, _PACKED) for p in path.iterdir())
    return path.suffix in _SUFFIXES or (path.is_file() and file_kind(path) in RECORDINGS)


def open_session(path: str | Path) -> Session:
    """Open a recording."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: expected {FORMS}, found no such file; check the path")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: expected {FORMS}, found a pipe or device; name a file or folder")
    if not is_recording(path):
        raise InputError(f"{path}: expected {FORMS}, found something else; check the path")
    try:
        if path.is_dir():
            return _open_folder(path)
        is_mcap = path.suffix == ".mcap" or file_kind(path) is FileKind.MCAP
        return McapSession(path, [path], {}) if is_mcap else _open_bag(path)
    except OSError as error:
        raise InputError(f"{path}: expected a readable recording; {error.strerror or error}") from None


def session_info(path: str | Path) -> SessionInfo:
    """Topics, types, counts, time and metadata of a recording."""
    with open_session(path) as session:
        return session.info


def _open_bag(path: Path) -> Session:
    try:
        return RosbagsSession(path)
    except InputError:
        if file_kind(path) is not FileKind.ROSBAG1:
            raise
        return BagScan(path)


def _open_folder(path: Path) -> Session:
    description, warnings = read_metadata(path)
    storage = description.get("storage_identifier", "")
    packed = str(description.get("compression_mode", "")).lower() not in ("", "none")
    files = storage_files(path, description)
    if not description and not any(p.suffix in _SUFFIXES for p in path.iterdir()):
        raise InputError(f"{path}: expected a usable {METADATA_FILE} of compressed files, found none; unpack: zstd -d")
    session: Session
    if files and storage in ("mcap", "") and not packed and all(f.suffix == ".mcap" for f in files):
        session = McapSession(path, files, custom_metadata(description))
    else:
        session = RosbagsSession(path)
    session.warnings += warnings
    return session
