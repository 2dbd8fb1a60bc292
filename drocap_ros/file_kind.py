"""What a file is by its first bytes; its name decides nothing."""

from __future__ import annotations

import re
from enum import Enum
from pathlib import Path

from drocap_ros.errors import InputError


class FileKind(Enum):
    """Kinds of files; the value is their name in messages."""

    VIDEO = "a video"
    IMAGE = "an image"
    MCAP = "an MCAP recording"
    ROSBAG1 = "a rosbag1 recording"
    SQLITE = "an SQLite recording"
    ARRAYS = "a zip archive or arrays"
    TEXT = "text"
    PACKED = "a packed file"
    EMPTY = "0 bytes"
    OTHER = "no header of a video"


RECORDINGS = frozenset({FileKind.MCAP, FileKind.ROSBAG1, FileKind.SQLITE})
#: The first bytes of each kind, the first match counts.  Text that FFmpeg takes for a video (playlists, its terminal
#: demuxer) is in no line.
_HEADS = [
    (kind, re.compile(pattern, re.DOTALL))
    for kind, pattern in (
        (FileKind.MCAP, rb"\x89MCAP0\r\n"),
        (FileKind.ROSBAG1, rb"#ROSBAG V"),
        (FileKind.SQLITE, rb"SQLite format 3\x00"),
        (FileKind.ARRAYS, rb"PK\x03\x04|PK\x05\x06|\x93NUMPY"),
        (FileKind.PACKED, rb"\x28\xb5\x2f\xfd|\x1f\x8b|BZh[1-9]|\xfd7zXZ\0|\x04\x22\x4d\x18|7z\xbc\xaf\x27\x1c|Rar!"),
        # JPEG, PNG, TIFF, BMP, WebP, PNM; OpenEXR, Radiance, JPEG 2000, HEIF and AVIF
        (FileKind.IMAGE, rb"\xff\xd8\xff|\x89PNG\r\n|II\*\0|MM\0\*|BM....\0\0\0\0|RIFF....WEBP|P[1-7]\s"),
        (FileKind.IMAGE, rb"\x76\x2f\x31\x01|#\?RADIANCE|\0\0\0\x0cjP  |....ftyp(heic|heix|mif1|msf1|avif)"),
        # MP4 and MOV, Matroska, AVI, FLV, ASF, Ogg, MXF, IVF, YUV4MPEG, GIF, RealMedia, DV, NUT, WTV
        (FileKind.VIDEO, rb"....(ftyp|styp|moov|moof|mdat|free|skip|wide|pnot|sidx)|\x1a\x45\xdf\xa3|RIFF....AVI"),
        (FileKind.VIDEO, rb"FLV\x01|\x30\x26\xb2\x75|OggS|\x06\x0e\x2b\x34|DKIF|YUV4MPEG2 |GIF8[79]a|\.RMF"),
        (FileKind.VIDEO, rb"\x1f\x07\x00|nut/multimedia container|\xb7\xd8\x00\x20|\x12\x00\x0a"),
        # elementary streams (MPEG, H.264, H.265, VC-1), MPEG programme streams; transport streams
        (FileKind.VIDEO, rb"\0{2,3}\x01[\x01-\x7f\xb0-\xba]|.{0,800}?\x47(.{187}\x47.{187}|.{191}\x47.{191})\x47"),
    )
]  # fmt: skip


def file_kind(path: Path) -> FileKind:
    """Kind of a file."""
    try:
        with path.open("rb") as file:
            # Bytes that are looked at: twenty packets of a transport stream, which may begin anywhere in one.
            head = file.read(4096)
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror or error}") from None
    if not head:
        return FileKind.EMPTY
    found, begins = next(((kind, match[0]) for kind, pattern in _HEADS if (match := pattern.match(head))), (None, b""))
    # The head of raw video alone may look like text.
    if found is FileKind.VIDEO and begins != b"YUV4MPEG2 " and _is_text(begins) and _is_text(head):
        return FileKind.TEXT  # "The free text" begins as a box `free` does
    return found or (FileKind.TEXT if _is_text(head) else FileKind.OTHER)


#: A stream's or web page's address, whose slashes a path has lost.
_ADDRESS = re.compile(r"([a-z][a-z\d+]+):/+(?=[^/])", re.IGNORECASE)


def missing(path: Path, expected: str) -> InputError:
    """The refusal of a path where nothing is, or of an address in its place."""
    if _ADDRESS.match(str(path)):
        address = _ADDRESS.sub(r"\1://", str(path), count=1)
        return InputError(f"{address}: expected {expected}, found an address; download the file and name it")
    return InputError(f"{path}: expected {expected}, found no such file or folder; check the path")


#: Ends of the names of packed files -> the command that unpacks one; of others -> what to do with one.
_UNPACK = {
    ".zstd": "zstd -d", ".zst": "zstd -d", ".gz": "gunzip", ".tgz": "tar -xf", ".tar": "tar -xf", ".bz2": "bunzip2",
    ".xz": "unxz", ".lz4": "unlz4", ".zip": "unzip", ".7z": "7z x", ".rar": "unrar x",
}  # fmt: skip
_OTHERS = {".npz": "see what is in it: drocap info", ".xml": "export COCO Keypoints instead of"}


def unpacking(path: Path) -> str:
    """What to do with a file that is none of the kinds that are read, after a sentence about it."""
    end = path.suffix.lower()
    words = f"unpack it: {_UNPACK[end]}" if end in _UNPACK else _OTHERS.get(end)
    return f"; {words} {path}" if words else "; check the file, or record it again"


def _is_text(head: bytes) -> bool:
    printable = sum(byte >= 0x20 or byte in b"\t\n\r\x1b" for byte in head)
    # Share of printable bytes from which a file is text: of UTF-8 in any language.
    return printable >= 0.85 * len(head) and b"\0" not in head
