"""Images of a video whose packets come one by one, as in messages."""

from __future__ import annotations

import re
import struct
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.video import VideoSource

#: name of a codec -> (its code in an IVF file, the packet with which decoding begins)
_CODECS = (
    (re.compile(r"h\.?264|avc", re.IGNORECASE), b"H264", re.compile(rb"\0\0\x01[\x07\x27\x47\x67]")),
    (re.compile(r"h\.?265|hevc", re.IGNORECASE), b"HEVC", re.compile(rb"\0\0\x01[\x40\x42]\x01")),
    (re.compile(r"vp9", re.IGNORECASE), b"VP90", re.compile(b"")),
    (re.compile(r"av0?1", re.IGNORECASE), b"AV01", re.compile(b"")),
    (re.compile(r"mjpe?g", re.IGNORECASE), b"MJPG", re.compile(b"")),
)
#: IVF: https://wiki.multimedia.cx/index.php/IVF; the stamps are microseconds.
_IVF_HEAD = struct.Struct("<4sHH4sHHIIII")
_IVF_PACKET = struct.Struct("<IQ")


def decoded_packets(codec: str, packets: Iterable[tuple[int, bytes]]) -> Iterator[tuple[int, np.ndarray]]:
    """Stamps and images of packets with their stamps; those before the first key frame are left out.

    FFmpeg reads them as a file, which is written first: a decoder may order them anew.

    Raises
    ------
    InputError
        When the codec is unknown, or nothing decodes.
    """
    found = next(((code, key) for name, code, key in _CODECS if name.search(codec)), None)
    if found is None:
        raise InputError(f"video: expected H.264, H.265, VP9, AV1 or MJPEG, found {codec[:40]!r}; convert it")
    with tempfile.TemporaryDirectory(prefix="drocap_") as folder:
        path = Path(folder) / "video.ivf"
        stamps = _write(path, packets, *found)
        if not len(stamps):
            raise InputError(f"video: expected a key frame of {found[0].decode()}, found none; record it again")
        try:
            with VideoSource(path) as source:
                for frame in source:
                    yield int(stamps[np.argmin(np.abs(stamps - stamps[0] - frame.stamp_ns))]), frame.image
        except InputError as error:
            raise InputError(str(error).replace(str(path), "video")) from None


def _write(path: Path, packets: Iterable[tuple[int, bytes]], code: bytes, key: re.Pattern[bytes]) -> np.ndarray:
    """Write the packets from the first key frame on; their stamps (N,) ns, sorted."""
    stamps: list[int] = []
    with path.open("wb") as file:
        file.write(_IVF_HEAD.pack(b"DKIF", 0, _IVF_HEAD.size, code, 0, 0, 1_000_000, 1, 0, 0))
        for stamp_ns, data in packets:
            if data and (stamps or key.search(data)):
                stamps.append(stamp_ns)
                file.write(_IVF_PACKET.pack(len(data), max(stamp_ns - stamps[0], 0) // 1000) + data)
    return np.sort(np.array(stamps, np.int64))
