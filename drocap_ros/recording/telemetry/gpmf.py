"""Positions of a GoPro from the track ``gpmd`` inside its videos (https://github.com/gopro/gpmf-parser).

A sample holds nested entries: four letters, type, size of a structure, number of structures, data in steps of four
bytes.  In a stream ``SCAL`` divides the values behind it.  The camera's orientation (``CORI``) has no north and is not
used.
"""

from __future__ import annotations

import datetime
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import (
    FIX_3D,
    Lack,
    LogLack,
    Series,
    TelemetryLog,
    from_first_fix,
    make_log,
    plausible,
)
from drocap_ros.recording.telemetry.video_tracks import read_samples
from drocap_ros.tracks import MAX_FRAMES

#: Format of the track's samples.
CODE = "gpmd"
#: Types of numbers and their codes of ``struct``.
_CODES = {"b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "f": "f", "d": "d", "j": "q", "J": "Q"}
_DEEPEST = 4


def read_gpmf(path: Path, number: int) -> TelemetryLog:
    """Positions (GPS9, else GPS5) by the video's clock; those of a sample are even in time."""
    stamps, places, starts = list[int](), list[np.ndarray](), list[float]()
    for stamp_ns, data in read_samples(path, number):
        fixes, utc_s = _fixes(data)
        stamps.append(stamp_ns)
        places.append(fixes)
        starts += [] if utc_s is None else [utc_s * 1e9 - stamp_ns]
    counts = [len(fixes) for fixes in places]
    if not 0 < sum(counts) <= MAX_FRAMES:
        raise InputError(f"{path}: expected positions in the GoPro track, found none; was GPS on? give a log beside it")
    # Seconds of a sample where no later one shows them.
    ends = [*stamps[1:], stamps[-1] + 10**9]
    at = [start + (end - start) * np.arange(n) // max(n, 1) for start, end, n in zip(stamps, ends, counts, strict=True)]
    stamp_ns, place = np.concatenate(at).astype(np.int64), np.concatenate(places)
    found, lacks = plausible(path, Series.of_places(stamp_ns, place))
    lacks.append(LogLack(Lack.HEIGHT, "height above the sea"))
    log = make_log(path, "GoPro GPMF track", stamp_ns, lacks, position=from_first_fix(found.geodetic))
    return log._replace(video_clock=True, utc_minus_stamp_ns=round(float(np.median(starts))) if starts else None)


def _fixes(data: bytes) -> tuple[np.ndarray, float | None]:
    """Latitude, longitude deg and height m (N, 3) of a sample, by GPS9, else GPS5; UTC of the first, s, or None."""
    older: tuple[np.ndarray, float | None] = np.zeros((0, 3)), None
    for stream in _streams(data, 0):
        scale = np.array(_numbers(*stream["SCAL"]) if "SCAL" in stream else [1.0], np.float64)
        if "GPS9" in stream and len(scale) == 9:
            kind, content = stream["GPS9"]
            form = struct.Struct(">lllllllHH" if kind == "?" else f">9{_CODES.get(kind, 'i')}")
            rows = _rows(form.iter_unpack(content[: len(content) // form.size * form.size]), scale)
            rows[rows[:, 8] < FIX_3D, :3] = np.nan
            known = rows[np.isfinite(rows[:, 0])]
            since_2000 = 946_684_800.0
            return rows[:, :3], since_2000 + 86_400 * known[0, 5] + known[0, 6] if len(known) else None
        if "GPS5" in stream and len(scale) == 5:
            values = _numbers(*stream["GPS5"])
            rows = _rows(values[: len(values) // 5 * 5], scale)
            fix = (_numbers(*stream["GPSF"]) or [0])[0] if "GPSF" in stream else FIX_3D
            rows[:, :3] = rows[:, :3] if fix >= FIX_3D else np.nan
            older = rows[:, :3], _utc_s(stream.get("GPSU", ("", b""))[1])
    return older


def _rows(values: Iterable[object], scale: np.ndarray) -> np.ndarray:
    return np.asarray(np.array(list(values), dtype=np.float64).reshape(-1, len(scale)) / scale)


def _utc_s(text: bytes) -> float | None:
    """UTC of yymmddhhmmss.sss."""
    try:
        time = datetime.datetime.strptime(text.decode("ascii").rstrip("\0"), "%y%m%d%H%M%S.%f")
    except ValueError:
        return None
    return time.replace(tzinfo=datetime.timezone.utc).timestamp()


def _streams(data: bytes, depth: int) -> Iterator[dict[str, tuple[str, bytes]]]:
    """Entries by name of each innermost group; damage ends a group."""
    found: dict[str, tuple[str, bytes]] = {}
    place = 0
    while place + 8 <= len(data):
        name, kind, size, count = struct.unpack_from(">4s1sBH", data, place)
        length = size * count
        content = data[place + 8 : place + 8 + length]
        place += 8 + (length + 3) // 4 * 4
        if kind == b"\0" and depth < _DEEPEST:
            yield from _streams(content, depth + 1)
        elif len(content) == length:
            found[name.decode("latin1")] = kind.decode("latin1"), content
    if found:
        yield found


def _numbers(kind: str, content: bytes) -> list[float]:
    code = _CODES.get(kind)
    if code is None:
        return []
    form = struct.Struct(f">{code}")
    return [float(value) for (value,) in form.iter_unpack(content[: len(content) // form.size * form.size])]
