"""Images of a video whose packets come one by one, as in messages."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.video import VideoSource

#: name of a codec -> (its name in Matroska, the packet with which decoding begins)
_CODECS = (
    (re.compile(r"[hx]\.?264|avc", re.IGNORECASE), b"V_MPEG4/ISO/AVC", re.compile(rb"\0\0\x01[\x07\x27\x47\x67]")),
    (re.compile(r"[hx]\.?265|hevc", re.IGNORECASE), b"V_MPEGH/ISO/HEVC", re.compile(rb"\0\0\x01[\x40\x42]\x01")),
    (re.compile(r"vp9", re.IGNORECASE), b"V_VP9", re.compile(b"")),
    (re.compile(r"mjpe?g", re.IGNORECASE), b"V_MJPEG", re.compile(b"")),
)


def _element(number: str, content: bytes | int) -> bytes:
    """An element of Matroska (RFC 9559) with its length in eight bytes."""
    data = content.to_bytes(8, "big") if isinstance(content, int) else content
    return bytes.fromhex(number) + (len(data) | 1 << 56).to_bytes(8, "big") + data


def decoded_packets(codec: str, packets: Iterable[tuple[int, bytes]]) -> Iterator[tuple[int, np.ndarray]]:
    """Stamps and images of packets with their stamps; those before the first key frame are left out.

    FFmpeg reads them as a file, which is written first: a decoder may order them anew.
    """
    found = next(((code, key) for name, code, key in _CODECS if name.search(codec)), None)
    if found is None:
        raise InputError(f"video: expected H.264, H.265, VP9 or MJPEG, found {codec[:40]!r}; convert it")
    with tempfile.TemporaryDirectory(prefix="drocap_") as folder:
        path = Path(folder) / "video.mkv"
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
        file.write(_element("1A45DFA3", _element("4282", b"matroska")) + bytes.fromhex("1853806701FFFFFFFFFFFFFF"))
        track = _element("D7", 1) + _element("73C5", 1) + _element("83", 1) + _element("86", code)
        track += _element("E0", _element("B0", 16) + _element("BA", 16))  # the stream itself states its size
        file.write(_element("1549A966", _element("2AD7B1", 1000)) + _element("1654AE6B", _element("AE", track)))
        for stamp_ns, data in packets:
            if data and (stamps or key.search(data)):
                stamps.append(stamp_ns)
                time = _element("E7", max(stamp_ns - stamps[0], 0) // 1000)  # us
                file.write(_element("1F43B675", time + _element("A3", b"\x81\0\0\x80" + data)))
    return np.sort(np.array(stamps, np.int64))
