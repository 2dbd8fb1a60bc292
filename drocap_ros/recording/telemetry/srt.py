"""States of the camera from the subtitles that a DJI drone writes beside its video.

Supported forms: bracketed ``[latitude: 47.3] [rel_alt: 10.0 abs_alt: 450.1] [gb_yaw: 12.3 gb_pitch: -20.0
gb_roll: 0.0]``, the gimbal also as ``gimbal_yaw``, the aircraft as ``drone_yaw`` or ``flight_yaw``; ``F_PRY (..°, ..°,
..°), G.PRY (..)`` (flight and gimbal pitch, roll, yaw); and the older ``GPS(lon,lat,n) BAROMETER:20.5``, of some models
``GPS(lat,lon,0.0M)`` or ``GPS(E:lon, N:lat, 5.0m)``, with RTK ``RTK (lon, lat, n)``.
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
    METRES_PER_DEG,
    Lack,
    Lens,
    LogFormat,
    LogLack,
    TelemetryLog,
    dji_attitude,
    from_first_fix,
    lens_of_views,
    make_log,
)
from drocap_ros.recording.telemetry.video_tracks import find_track, read_samples
from drocap_ros.recording.text import open_text
from drocap_ros.tracks import MAX_FRAMES

#: Formats of a video's subtitle tracks: of MP4 (3GPP TS 26.245, QuickTime), whose texts begin with their length, and by
#: their codecs of other containers.
_WITH_LENGTH = ("tx3g", "text")
TEXT_TRACKS = (*_WITH_LENGTH, "subrip", "srt", "webvtt")
#: Characters of a line, and of a subtitle; more are cut off.  DJI's have some hundreds.
_LINE = 8192
#: Sources of a height, the preferred one first.
_HEIGHTS = ("rel_alt", "barometer", "abs_alt", "altitude")
_NUMBER = r"([-+]?\d{1,10}(?:\.\d{1,12})?)"
_TIME = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{1,3})\s*-->")
_VALUE = re.compile(rf"\b(latitude|longitude|longtitude|rel_alt|abs_alt|altitude)\s*:\s*{_NUMBER}", re.IGNORECASE)
#: Angles by name: of the gimbal, or of the aircraft.
_ANGLE = re.compile(rf"\b(gb|gimbal|drone|flight|aircraft)[_. ]?(pitch|roll|yaw)(?:degree)?\s*:\s*{_NUMBER}", re.I)
_CLOCK = re.compile(r"\d\s+(\d{1,2}):(\d\d):(\d\d[.,]\d{3})")
_GPS = re.compile(
    rf"\b(?:GPS|RTK)\s*\(\s*([NSEW]?):?\s*{_NUMBER}\s*,\s*([NSEW]?):?\s*{_NUMBER}\s*,\s*{_NUMBER}\s*(m?)", re.I
)
_BAROMETER = re.compile(rf"\b(?:BAROMETER|Hb)\s*[:(]\s*{_NUMBER}|[,\s]H\s*=?\s*{_NUMBER}\s*m")
#: Place of take-off, and the distance from it, m.
_DISTANCE = re.compile(rf"\bHOME\s*\(\s*{_NUMBER}\s*,\s*{_NUMBER}[^\n]*\bD\s*=?\s*{_NUMBER}\s*m")
_LENS = re.compile(rf"\b(focal_len|dzoom_ratio)\s*:\s*{_NUMBER}", re.IGNORECASE)
#: Horizontal field of view, deg.
_VIEW = re.compile(rf"\b(?:fov_?h|h_?fov|horizontal_?fov|fov_?horizontal)\s*[:=]\s*{_NUMBER}", re.IGNORECASE)
#: Pitch, roll and yaw; the degree sign may be in any encoding.
_THREE = r"[^-+,()0-9]{0,8},\s*".join([_NUMBER] * 3)
_PRY = re.compile(rf"\b([FG])[._ ]?PRY\s*:?\s*\(\s*{_THREE}[^,()0-9]{{0,8}}\)", re.IGNORECASE)


class _Entry(NamedTuple):
    """One subtitle: time ns in the video; latitude, longitude deg and height m; pitch roll yaw deg.

    lens : mm, digital zoom, view deg
    kind : of the height, "" = none
    clock_s : time of day
    home : place of take-off in the order of the text, and the distance from it, m
    plain : 1 where nothing beside the numbers says which of them is the latitude, 2 beside a height
    """

    stamp_ns: int
    geodetic: tuple[float, float, float]
    kind: str
    gimbal: tuple[float, float, float]
    body: tuple[float, float, float]
    lens: tuple[float, float, float]
    clock_s: float
    home: tuple[float, float, float]
    plain: float


_UNKNOWN = (math.nan, math.nan, math.nan)


def read_srt(path: Path) -> TelemetryLog:
    """Gimbal attitude and position of every subtitle, by the video's own clock."""
    entries = _entries(path)
    stamps, places, kinds, gimbal, body, lens, clock_s, home, plain = map(np.array, zip(*entries, strict=True))
    if _latitude_first(places, home, plain):
        places[plain > 0, :2] = places[plain > 0, 1::-1]
    heights = next((kind for kind in _HEIGHTS if kind in kinds), "height")
    position = from_first_fix(_geodetic(places), above_takeoff=heights == "rel_alt")
    lacks = [LogLack(Lack.HEIGHT, heights)] if position is not None and heights != "rel_alt" else []
    if position is None and np.isfinite(places[:, 0]).any():  # the Mavic 2 writes no height
        position = from_first_fix(_geodetic(np.column_stack([places[:, :2], np.zeros(len(places))])))
        lacks = [LogLack(Lack.HEIGHT_UNKNOWN)]
    real_s, shown_s = clock_s[-1] - clock_s[0], float(stamps[-1] - stamps[0]) * 1e-9
    if 1 < real_s < shown_s / 1.5:  # a second or more, and no rounding of the dates
        lacks.append(LogLack(Lack.SLOW, f"{shown_s / real_s:.1f}"))
    steady, zoom = _lens(lens)
    lacks += zoom
    attitudes = {"orientation": dji_attitude(body), "gimbal": dji_attitude(gimbal)}
    log = make_log(path, "DJI subtitles", stamps, lacks, position=position, **attitudes)
    return log._replace(video_clock=True, lens=steady)


def _entries(path: Path) -> list[_Entry]:
    read = _subtitles if path.suffix.lower() == FORMAT.suffix else _inside
    found = (_entry(stamp_ns, text) for stamp_ns, text in read(path))
    entries = list(itertools.islice(filter(None, found), MAX_FRAMES + 1))
    if not 0 < len(entries) <= MAX_FRAMES:
        words = f"{path}: expected 1 to {MAX_FRAMES} DJI subtitles with telemetry, found {len(entries)}"
        raise InputError(words if entries else f"{words}; some models, as the Mavic Air, write none: use a flight log")
    return entries


def _latitude_first(places: np.ndarray, home: np.ndarray, plain: np.ndarray) -> bool:
    """Whether plain pairs, taken as longitude and latitude, are the other way round.

    A latitude is below 90 degrees, the distance from take-off fits one order, and before a height it comes first.
    """
    latitude, longitude = places[plain > 0, :2].T
    if (np.abs(latitude) > 90).any():
        return bool((np.abs(longitude) <= 90).all())
    if (np.abs(longitude) > 90).any():
        return False
    (at_east, at_north, way), by_height = home[plain > 0].T, bool((plain > 1).any())
    east, north = longitude - at_east, latitude - at_north
    off = [
        np.abs(METRES_PER_DEG * np.hypot(dx * np.cos(np.deg2rad(at)), dy) - way)
        for dx, dy, at in ((east, north, latitude), (north, east, longitude))
    ]
    as_is, turned = (float(np.nansum(errors)) for errors in off)
    return turned < 0.5 * as_is or (by_height and not as_is < 0.5 * turned)


def _geodetic(places: np.ndarray) -> np.ndarray:
    """(N, 3) latitude and longitude in degrees, height; NaN where they are no place."""
    geodetic = places.copy()
    farthest = np.abs(geodetic[np.isfinite(geodetic[:, 0]), :2]).max(axis=0, initial=0.0)
    if farthest.any() and (farthest <= (np.pi / 2, np.pi)).all():  # as degrees all of it would be the open Atlantic
        geodetic[:, :2] = np.rad2deg(geodetic[:, :2])
    geodetic[(np.abs(geodetic[:, :2]) > (90, 180)).any(axis=1) | (geodetic[:, :2] == 0).all(axis=1)] = np.nan
    return geodetic


def _inside(path: Path) -> Iterator[tuple[int, str]]:
    """Time ns and text of each sample of a video's subtitle track."""
    if found := find_track(path, TEXT_TRACKS):
        for stamp_ns, data in read_samples(path, found[0]):
            text = data[2 : 2 + int.from_bytes(data[:2], "big")] if found[1] in _WITH_LENGTH else data
            yield stamp_ns, text[:_LINE].decode("utf-8", errors="replace")


def _subtitles(path: Path) -> Iterator[tuple[int, str]]:
    """Time ns in the video and text of each subtitle."""
    stamp_ns, text = None, ""
    with open_text(path) as file:
        while line := file.readline(_LINE):
            line = re.sub(r"(:\s*-?\d+),(?=\d)", r"\1.", line)  # a decimal comma
            match = _TIME.search(line)
            if match is None:
                text = (text + line)[:_LINE]
                continue
            if stamp_ns is not None:
                yield stamp_ns, text
            hours, minutes, seconds = (int(match[i]) for i in (1, 2, 3))
            stamp_ns = ((hours * 60 + minutes) * 60 + seconds) * 10**9 + int(match[4].ljust(3, "0")) * 10**6
            text = ""
    if stamp_ns is not None:
        yield stamp_ns, text


def _entry(stamp_ns: int, text: str) -> _Entry | None:
    """One subtitle; None without telemetry."""
    values = _values(text)
    angles = {kind.upper(): (float(p), float(r), float(y)) for kind, p, r, y in _PRY.findall(text)}
    named: dict[str, dict[str, float]] = {"G": {}, "F": {}}
    for of, angle, number in _ANGLE.findall(text):
        named["G" if of.lower() in ("gb", "gimbal") else "F"][angle.lower()] = float(number)
    for of, found in named.items():
        if "yaw" in found and "pitch" in found:
            angles[of] = (found["pitch"], found.get("roll", 0.0), found["yaw"])
    kind = next((name for name in _HEIGHTS if name in values), "")
    if not kind and not angles and "latitude" not in values:
        return None
    place = (values.get("latitude", math.nan), values.get("longitude", math.nan), values.get(kind, math.nan))
    gimbal, body = (angles.get(of, _UNKNOWN) for of in "GF")
    way = _DISTANCE.search(text)
    home = (float(way[1]), float(way[2]), float(way[3])) if way else _UNKNOWN
    return _Entry(stamp_ns, place, kind, gimbal, body, _focal(text), _clock_s(text), home, values.get("plain", 0.0))


def _values(text: str) -> dict[str, float]:
    """Numbers of a subtitle by name: coordinates, heights and the gimbal's angles, in any of its forms."""
    values = {name.lower(): float(number) for name, number in _VALUE.findall(text)}
    if "longtitude" in values:  # as some models spell it
        values.setdefault("longitude", values["longtitude"])
    if "latitude" not in values and (gps := _GPS.search(text)):
        # Without letters: with a height in m latitude is first, else longitude.
        latitude_first = gps[1].upper() in ("N", "S") if gps[1] else gps[6]
        names = ("latitude", "longitude") if latitude_first else ("longitude", "latitude")
        values |= {names[0]: _coordinate(gps[1], gps[2]), names[1]: _coordinate(gps[3], gps[4])}
        if gps[6] or "." in gps[5]:  # else the number of satellites
            values["altitude"] = float(gps[5])
        if not gps[1] and not gps[6]:
            values["plain"] = 2.0 if "." in gps[5] else 1.0
    if barometer := _BAROMETER.search(text):
        values["barometer"] = float(barometer[1] or barometer[2])
    return values


def _coordinate(letter: str, number: str) -> float:
    return -float(number) if letter.upper() in ("S", "W") else float(number)


def _clock_s(text: str) -> float:
    """Time of day, NaN where the subtitle has none."""
    found = _CLOCK.search(text)
    return 3600 * int(found[1]) + 60 * int(found[2]) + float(found[3].replace(",", ".")) if found else math.nan


def _focal(text: str) -> tuple[float, float, float]:
    """35 mm equivalent in mm, digital zoom and horizontal view in deg; NaN, 1 and NaN where the subtitle has none."""
    found = {name.lower(): number for name, number in _LENS.findall(text)}
    focal, zoom, view = found.get("focal_len", "nan"), found.get("dzoom_ratio", "1"), _VIEW.search(text)
    # Without a decimal point they count tenths of a mm and ten thousandths.
    factor = 1.0 if "." in zoom or float(zoom) < 100 else 1e-4
    return float(focal) * (1.0 if "." in focal else 0.1), float(zoom) * factor, float(view[1]) if view else math.nan


def _lens(values: np.ndarray) -> tuple[Lens | None, list[LogLack]]:
    """The lens of all subtitles (N, 3), the usual one where they state none; None and why where it changes."""
    stated = values[(values[:, 0] >= 5) & (values[:, 0] <= 1000) & (values[:, 1] >= 1) & (values[:, 1] <= 100), :2]
    if len(stated) and (np.ptp(stated, axis=0) > 0.01 * np.median(stated, axis=0)).any():
        seen = stated.prod(axis=1)
        return None, [LogLack(Lack.ZOOM, f"{seen.min():.0f} mm to {seen.max():.0f} mm")]
    if np.isfinite(values[:, 2]).any() or not len(stated):
        return lens_of_views(values[:, 2], "as the subtitles state")
    focal, zoom = np.median(stated, axis=0)
    return Lens(float(focal), f"{focal:g} mm equivalent of the subtitles, full sensor width assumed", float(zoom)), []


FORMAT = LogFormat(".srt", read_srt)
