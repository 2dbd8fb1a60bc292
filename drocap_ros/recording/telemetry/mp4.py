"""Boxes and sample tables of an MP4 or MOV file (ISO/IEC 14496-12), read by seeking.

Only headers and tables are read, never the media.  Counts, sizes and nesting are bounded by the boxes that state them
and by the file's size.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.tracks import MAX_FRAMES

# Bounds against damaged files; whole ones are far below.
_MAX_CHILDREN = 4096
_MAX_TRACKS = 64  # a drone's video has less than ten
_MAX_DURATION_S = 1e6  # s: eleven days
#: Seconds from 1904, from which MP4 counts, to 1970.
_EPOCH_S = 2_082_844_800
#: Creation times, s from 1970, of a clock that was set: 2000 to 2100.
_EARLIEST_S = 946_684_800
_LATEST_S = 4_102_444_800  # s: 2100-01-01


class Box(NamedTuple):
    """A box: its type, and where its content begins and ends in the file."""

    name: bytes
    start: int
    end: int


class Samples(NamedTuple):
    """Samples of a track: place and size (N,) int64 bytes, and time (N,) int64 ns from the track's start."""

    offset: np.ndarray
    size: np.ndarray
    stamp_ns: np.ndarray


class Track(NamedTuple):
    """A track.

    handler : "vide", "soun", "meta", ...
    sample_format : "avc1", "hvc1", "djmd", ...
    size : (width, height) px of a video, else (0, 0)
    time_scale : ticks per second
    table : the box of its sample tables
    """

    handler: str
    sample_format: str
    size: tuple[int, int]
    time_scale: int
    table: Box


def read_tracks(file: IO[bytes]) -> list[Track]:
    """Tracks of an open file; none where it is no MP4, or its index is missing or damaged."""
    moov = _find(file, Box(b"", 0, file.seek(0, 2)), b"moov")
    tracks = (_track(file, box) for box in _children(file, moov) if box.name == b"trak")
    return list(itertools.islice((track for track in tracks if track), _MAX_TRACKS))


def read_samples(file: IO[bytes], track: Track) -> Samples:
    """Places and times of a track's samples; samples beyond the file's end are left out."""
    boxes = {box.name: box for box in _children(file, track.table)}
    length = file.seek(0, 2)
    sizes = _sizes(file, boxes.get(b"stsz"), length)
    chunk = boxes.get(b"co64") or boxes.get(b"stco")
    offsets = _table(file, chunk, ">u8" if chunk and chunk.name == b"co64" else ">u4", 1)[:, 0]
    runs = _table(file, boxes.get(b"stsc"), ">u4", 3)
    times = _table(file, boxes.get(b"stts"), ">u4", 2)
    first = np.append(runs[:, 0], len(offsets) + 1)
    if not len(runs) or first[0] != 1 or np.any(np.diff(first) < 0):
        raise InputError("expected chunks in order (stsc), found others")
    per_chunk = np.repeat(runs[:, 1], np.diff(first))
    ends = np.minimum(np.cumsum(per_chunk), len(sizes))
    counts = np.diff(ends, prepend=0)
    deltas = np.repeat(times[:, 1], np.diff(np.minimum(np.cumsum(times[:, 0]), len(sizes)), prepend=0))
    count = min(int(counts.sum()), len(deltas))
    place = np.cumsum(sizes) - sizes  # bytes before each sample, of all chunks
    begin = ends - counts  # first sample of each chunk
    offset = (np.repeat(offsets, counts) + place[: counts.sum()] - np.repeat(place[begin % len(sizes)], counts))[:count]
    seconds = (np.cumsum(deltas) - deltas)[:count] / track.time_scale
    if seconds.max(initial=0.0) > _MAX_DURATION_S:
        raise InputError(f"expected samples within {_MAX_DURATION_S:.0f} s, found one at {seconds.max():.0f} s")
    stamp_ns = np.round(seconds * 1e9).astype(np.int64)
    inside = (offset + sizes[:count] <= length) & (sizes[:count] > 0)
    return Samples(offset[inside], sizes[:count][inside], stamp_ns[inside])


def duration_s(path: Path) -> float | None:
    """Duration of the movie as ``mvhd`` states it, None where it is unknown."""
    found = _movie_header(path)
    return found[1] if found and 0 < found[1] < _MAX_DURATION_S else None


def creation_time_ns(path: Path) -> int | None:
    """Creation time (UTC ns) in ``mvhd``, None where there is none."""
    found = _movie_header(path)
    unix_s = found[0] - _EPOCH_S if found else 0
    return unix_s * 10**9 if _EARLIEST_S < unix_s < _LATEST_S else None


def _movie_header(path: Path) -> tuple[int, float] | None:
    """Creation time s from 1904 and duration s."""
    try:
        with path.open("rb") as file:
            box = _find(file, Box(b"", 0, file.seek(0, 2)), b"moov", b"mvhd")
            data = _read(file, box, 0, 32)
    except OSError:
        return None
    if len(data) < 32:
        return None
    created, _, scale, duration = struct.unpack_from(">QQIQ" if data[0] == 1 else ">IIII", data, 4)
    return created, duration / scale if scale else 0.0


def _children(file: IO[bytes], parent: Box | None) -> Iterator[Box]:
    place = parent.start if parent else 0
    for _ in range(_MAX_CHILDREN):
        if parent is None or place + 8 > parent.end:
            return
        file.seek(place)
        head = file.read(16)
        if len(head) < 8:
            return
        (length, name), skip = struct.unpack_from(">I4s", head), 8
        if length == 1 and len(head) == 16:
            length, skip = struct.unpack_from(">Q", head, 8)[0], 16
        elif length == 0:
            length = parent.end - place
        if length < skip:
            return
        yield Box(name, place + skip, min(place + length, parent.end))
        place += length


def _find(file: IO[bytes], parent: Box | None, *names: bytes) -> Box | None:
    """The first box along a path of types."""
    for name in names:
        parent = next((box for box in _children(file, parent) if box.name == name), None)
    return parent


def _read(file: IO[bytes], box: Box | None, start: int, count: int) -> bytes:
    """Bytes of a box from ``start`` on, fewer where it ends; none of a missing box."""
    if box is None:
        return b""
    file.seek(box.start + start)
    return file.read(max(0, min(count, box.end - box.start - start)))


def _track(file: IO[bytes], trak: Box) -> Track | None:
    boxes = {box.name: box for box in _children(file, _find(file, trak, b"mdia"))}
    table = _find(file, boxes.get(b"minf"), b"stbl")
    header = _read(file, boxes.get(b"mdhd"), 0, 24)
    handler = _read(file, boxes.get(b"hdlr"), 8, 4)
    entry = _read(file, _find(file, table, b"stsd"), 8, 36)
    if table is None or len(header) < 24 or len(handler) < 4 or len(entry) < 8:
        return None
    scale = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)[0]
    size = struct.unpack_from(">HH", entry, 32) if handler == b"vide" and len(entry) == 36 else (0, 0)
    return Track(handler.decode("latin1"), entry[4:8].decode("latin1"), size, scale, table) if scale else None


def _table(file: IO[bytes], box: Box | None, kind: str, columns: int) -> np.ndarray:
    """(N, columns) int64 entries of a table with a count before them; values that no int64 holds are clipped."""
    head = _read(file, box, 4, 4)
    if box is None or len(head) < 4:
        raise InputError("expected sample tables, found none")
    count = struct.unpack(">I", head)[0]
    width = np.dtype(kind).itemsize * columns
    if count > min(MAX_FRAMES, (box.end - box.start - 8) // width):
        raise InputError(f"expected a table {box.name.decode('latin1')} inside its box, found {count} entries")
    data = _read(file, box, 8, count * width)
    if len(data) < count * width:
        raise InputError("expected whole sample tables, found the file cut off")
    values = np.frombuffer(data, kind).astype(np.uint64)
    return np.minimum(values, np.uint64(2**61)).astype(np.int64).reshape(-1, columns)


def _sizes(file: IO[bytes], box: Box | None, length: int) -> np.ndarray:
    """(N,) bytes; all samples together must fit into the file."""
    head = _read(file, box, 4, 8)
    if box is None or len(head) < 8:
        raise InputError("expected sample sizes (stsz), found none")
    common, count = struct.unpack(">II", head)
    if count == 0:  # they stand between the parts of the video, as browsers and streaming programs write
        raise InputError(
            "expected samples in the index, found none (a fragmented MP4); rewrite it: ffmpeg -i IN -c copy OUT"
        )
    if count > MAX_FRAMES or common * count > length:
        raise InputError(f"expected 1 to {MAX_FRAMES} samples inside the file, found {count} of {common} bytes")
    if common:
        return np.full(count, common, np.int64)
    sizes = _table(file, Box(box.name, box.start + 4, box.end), ">u4", 1)[:, 0]
    if sizes.sum() > length:
        raise InputError(f"expected samples inside the file, found {sizes.sum()} bytes of them in {length}")
    return sizes
