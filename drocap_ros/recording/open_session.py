"""Opens a recording: ours, rosbag2's (MCAP or sqlite3), a single ``.mcap``, or a rosbag1 ``.bag``."""

from __future__ import annotations

from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.file_kind import RECORDINGS, FileKind, file_kind
from drocap_ros.recording.bag_scan import BagScan
from drocap_ros.recording.mcap.metadata import METADATA_FILE, custom_metadata, read_metadata, storage_files
from drocap_ros.recording.session import FORMS, Session, SessionInfo
from drocap_ros.recording.session_readers import McapSession, RosbagsSession

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
