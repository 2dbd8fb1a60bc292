"""States of the camera from the subtitles that a DJI drone writes beside its video.

Supported forms: bracketed ``[latitude: 47.3] [rel_alt: 10.0 abs_alt: 450.1] [gb_yaw: 12.3 gb_pitch: -20.0
gb_roll: 0.0]``; ``F_PRY (..°, ..°, ..°), G.PRY (..)`` (flight and gimbal pitch, roll, yaw); and the older
``GPS(lon,lat,n) BAROMETER:20.5``, of some models ``GPS(lat,lon,0.0M)`` or ``GPS(E:lon, N:lat, 5.0m)``.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import (
    Lack,
    Lens,
    LogFormat,
    LogLack,
    TelemetryLog,
    dji_attitude,
    from_first_fix,
    make_log,
)
from drocap_ros.recording.telemetry.mp4 import read_samples, read_tracks
from drocap_ros.tracks import MAX_FRAMES

#: Formats of a video's subtitle tracks (3GPP TS 26.245, QuickTime).
TEXT_TRACKS = ("tx3g", "text")
#: Characters of a line, and of a subtitle; more are cut off.  DJI's have some hundreds.
_LINE = 8192
#: Sources of a height, the preferred one first.
_HEIGHTS = ("rel_alt", "barometer", "abs_alt", "altitude")
_NUMBER = r"([-+]?\d{1,10}(?:\.\d{1,12})?)"
_TIME = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})\s*-->")
_VALUE = re.compile(
    rf"\b(latitude|longitude|longtitude|rel_alt|abs_alt|altitude|gb_yaw|gb_pitch|gb_roll)\s*:\s*{_NUMBER}",
    re.IGNORECASE,
)
_CLOCK = re.compile(r"\d\s+(\d{1,2}):(\d\d):(\d\d[.,]\d{3})")
_GPS = re.compile(rf"\bGPS\s*\(\s*([NSEW]?):?\s*{_NUMBER}\s*,\s*([NSEW]?):?\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(m?)", re.I)
_BAROMETER = re.compile(rf"\bBAROMETER\s*:\s*{_NUMBER}|,\s*H\s*{_NUMBER}\s*m")
_LENS = re.compile(rf"\b(focal_len|dzoom_ratio)\s*:\s*{_NUMBER}", re.IGNORECASE)
_PRY = re.compile(rf"\b([FG])[._ ]?PRY\s*\(\s*{_NUMBER}°?\s*,\s*{_NUMBER}°?\s*,\s*{_NUMBER}°?\s*\)")


class _Entry(NamedTuple):
    """One subtitle: time ns in the video, geodetic, source of the height, pitch roll yaw deg, lens mm and zoom."""

    stamp_ns: int
    latitude: float
    longitude: float
    height: float
    kind: str
    gimbal: tuple[float, float, float]
    body: tuple[float, float, float]
    lens: tuple[float, float]
    clock_s: float


_UNKNOWN = (math.nan, math.nan, math.nan)


def read_srt(path: Path) -> TelemetryLog:
    """Gimbal attitude and position of every subtitle, by the video's own clock.

    Raises
    ------
    InputError
        When the file cannot be read or holds no telemetry.
    """
    read = _subtitles if path.suffix.lower() == FORMAT.suffix else _inside
    found = (_entry(stamp_ns, text) for stamp_ns, text in read(path))
    entries = list(itertools.islice((entry for entry in found if entry), MAX_FRAMES + 1))
    if not 0 < len(entries) <= MAX_FRAMES:
        raise InputError(f"{path}: expected 1 to {MAX_FRAMES} DJI subtitles with telemetry, found {len(entries)}")
    heights = next((kind for kind in _HEIGHTS if any(e.kind == kind for e in entries)), "height")
    stamps = np.array([e.stamp_ns for e in entries], np.int64)
    position = from_first_fix(_geodetic(entries), above_takeoff=heights == "rel_alt")
    lacks = [LogLack(Lack.HEIGHT, heights)] if position is not None and heights != "rel_alt" else []
    real_s, shown_s = entries[-1].clock_s - entries[0].clock_s, float(stamps[-1] - stamps[0]) * 1e-9
    if 1 < real_s < shown_s / 1.5:  # a second or more, and no rounding of the dates
        lacks.append(LogLack(Lack.SLOW, f"{shown_s / real_s:.1f}"))
    lens = np.array([e.lens for e in entries])
    if (steady := _lens(lens)) is None:
        lacks.append(LogLack(Lack.ZOOM, " to ".join(f"{f(np.nanprod(lens, axis=1)):.0f} mm" for f in (np.min, np.max))))
    body, gimbal = (
        dji_attitude(np.array(angles)) for angles in ([e.body for e in entries], [e.gimbal for e in entries])
    )
    log = make_log(path, "DJI subtitles", stamps, lacks, orientation=body, position=position, gimbal=gimbal)
    return log._replace(video_clock=True, lens=steady)


def _geodetic(entries: list[_Entry]) -> np.ndarray:
    """(N, 3) latitude and longitude in degrees, height; NaN where they are no place."""
    geodetic = np.array([(e.latitude, e.longitude, e.height) for e in entries])
    place = np.abs(geodetic[np.isfinite(geodetic[:, 0]), :2]).max(axis=0, initial=0.0)
    if place.any() and (place <= (np.pi / 2, np.pi)).all():  # as degrees all of it would be the open Atlantic
        geodetic[:, :2] = np.rad2deg(geodetic[:, :2])
    geodetic[(np.abs(geodetic[:, :2]) > (90, 180)).any(axis=1) | (geodetic[:, :2] == 0).all(axis=1)] = np.nan
    return geodetic


def _inside(path: Path) -> Iterator[tuple[int, str]]:
    """Time ns and text of each sample of a video's subtitle track: two bytes of length, then the text."""
    with path.open("rb") as file:
        for track in [track for track in read_tracks(file) if track.sample_format in TEXT_TRACKS][:1]:
            for offset, size, stamp_ns in zip(*(a.tolist() for a in read_samples(file, track)), strict=True):
                file.seek(offset)
                data = file.read(min(size, _LINE))
                yield stamp_ns, data[2 : 2 + int.from_bytes(data[:2], "big")].decode("utf-8", errors="replace")


def _subtitles(path: Path) -> Iterator[tuple[int, str]]:
    """Time ns in the video and text of each subtitle."""
    stamp_ns, text = None, ""
    try:
        with path.open("r", encoding="utf-8", errors="replace") as file:
            while line := file.readline(_LINE):
                match = _TIME.search(line)
                if match is None:
                    text = (text + line)[:_LINE]
                    continue
                if stamp_ns is not None:
                    yield stamp_ns, text
                hours, minutes, seconds = (int(match[i]) for i in (1, 2, 3))
                stamp_ns = ((hours * 60 + minutes) * 60 + seconds) * 10**9 + int(match[4].ljust(3, "0")) * 10**6
                text = ""
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror}") from None
    if stamp_ns is not None:
        yield stamp_ns, text


def _entry(stamp_ns: int, text: str) -> _Entry | None:
    """One subtitle; None without telemetry."""
    values = _values(text)
    angles = {kind.upper(): (float(p), float(r), float(y)) for kind, p, r, y in _PRY.findall(text)}
    gimbal = angles.get("G", _UNKNOWN)
    if "gb_yaw" in values and "gb_pitch" in values:
        gimbal = (values["gb_pitch"], values.get("gb_roll", 0.0), values["gb_yaw"])
    kind = next((name for name in _HEIGHTS if name in values), "")
    if not kind and not angles and math.isnan(gimbal[0]):
        return None
    latitude, longitude, height = (values.get(name, math.nan) for name in ("latitude", "longitude", kind))
    clock = _CLOCK.search(text)
    clock_s = 3600 * int(clock[1]) + 60 * int(clock[2]) + float(clock[3].replace(",", ".")) if clock else math.nan
    return _Entry(stamp_ns, latitude, longitude, height, kind, gimbal, angles.get("F", _UNKNOWN), _focal(text), clock_s)


def _values(text: str) -> dict[str, float]:
    """Numbers of a subtitle by name: coordinates, heights and the gimbal's angles, in any of its forms."""
    values = {name.lower(): float(number) for name, number in _VALUE.findall(text)}
    if "longtitude" in values:  # as some models spell it
        values.setdefault("longitude", values["longtitude"])
    if "latitude" not in values and (gps := _GPS.search(text)):
        first, second = (float(gps[i + 1]) * (-1 if gps[i].upper() in ("S", "W") and gps[i] else 1) for i in (1, 3))
        if gps[1].upper() in ("N", "S") if gps[1] else gps[6]:  # with a height in m latitude is first, else longitude
            first, second = second, first
        values |= {"longitude": first, "latitude": second, "altitude": float(gps[5])}
    if barometer := _BAROMETER.search(text):
        values["barometer"] = float(barometer[1] or barometer[2])
    return values


def _focal(text: str) -> tuple[float, float]:
    """35 mm equivalent in mm and digital zoom, NaN and 1 where the subtitle has none."""
    found = {name.lower(): number for name, number in _LENS.findall(text)}
    focal, zoom = found.get("focal_len", "nan"), found.get("dzoom_ratio", "1")
    # Without a decimal point they count tenths of a mm and ten thousandths.
    factor = 1.0 if "." in zoom or float(zoom) < 100 else 1e-4
    return float(focal) * (1.0 if "." in focal else 0.1), float(zoom) * factor


def _lens(values: np.ndarray) -> Lens | None:
    """The lens of all subtitles (N, 2); the usual one where they state none; None where it changes."""
    stated = values[(values[:, 0] >= 5) & (values[:, 0] <= 1000) & (values[:, 1] >= 1) & (values[:, 1] <= 100)]
    if not len(stated):
        return Lens()
    focal, zoom = np.median(stated, axis=0)
    if (np.ptp(stated, axis=0) > 0.01 * np.array([focal, zoom])).any():
        return None
    return Lens(float(focal), f"{focal:g} mm equivalent of the subtitles, full sensor width assumed", float(zoom))


FORMAT = LogFormat(".srt", read_srt)
