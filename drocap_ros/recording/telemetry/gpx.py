"""Positions of a GPX track (https://www.topografix.com/GPX/1/1), as apps and loggers write it."""

from __future__ import annotations

import contextlib
import datetime
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import ParseError, fromstring, iterparse

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.log import (
    Lack,
    LogFormat,
    LogLack,
    Series,
    TelemetryLog,
    choose,
    from_first_fix,
    make_log,
    plausible,
)
from drocap_ros.tracks import MAX_FRAMES

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element


#: Time UTC ns; latitude, longitude deg and height m, NaN unknown.
_Point = tuple[int, tuple[float, float, float]]


def read_gpx(path: Path, *, track: str = "") -> TelemetryLog:
    """Positions by UTC; a track of the file is one of several, from 1 on: the longest, unless ``track`` is wanted."""
    tracks, damaged = _tracks(path)
    if not tracks:
        raise InputError(f"{path}: expected points with times in a GPX track, found none; export it with times")
    number, lacks = choose(path, "track", {str(n): len(points) for n, points in tracks.items()}, track)
    points = tracks[int(number)]
    stamp_ns, place = (np.array(column) for column in zip(*points, strict=True))
    order = np.unique(stamp_ns, return_index=True)[1]
    stamp_ns, place = stamp_ns[order], place[order]
    if damaged:
        lacks.append(LogLack(Lack.DAMAGED, "points about the damage are missing"))
    if np.isnan(place[:, 2]).all():
        place[:, 2] = 0.0
        lacks.append(LogLack(Lack.HEIGHT_UNKNOWN))
    found, more = plausible(path, Series.of_places(stamp_ns, place))
    lacks += [*more, LogLack(Lack.LOCAL_POSITION, "point")]
    log = make_log(path, "GPX track", stamp_ns, lacks, position=from_first_fix(found.geodetic))
    return log._replace(utc_minus_stamp_ns=0)


def _tracks(path: Path) -> tuple[dict[int, list[_Point]], bool]:
    """Points with a time by the number of their track, and whether the file ends in damage."""
    found: dict[int, list[_Point]] = {}
    number = count = 0
    try:
        with path.open("rb") as file:
            if b"<!ENTITY" in file.read(4096):
                raise InputError(f"{path}: expected a GPX file, found entities of XML; export it again")
            file.seek(0)
            for event, element in iterparse(file, ("start", "end")):
                name = element.tag.rpartition("}")[2]
                number += event == "start" and name == "trk"
                if event == "end" and name in ("trkpt", "trkseg"):
                    point = _point(element) if name == "trkpt" and count < MAX_FRAMES else None
                    if point is not None:
                        count += 1
                        found.setdefault(number, []).append(point)
                    element.clear()
    except ParseError:  # the points behind the damage are read one by one
        return _one_by_one(path) or found, True
    return found, False


def _one_by_one(path: Path) -> dict[int, list[_Point]]:
    """Points that are whole, by the number of their track."""
    found: dict[int, list[_Point]] = {}
    number = 0
    for part in re.finditer(r"<trk>|<trkpt .*?</trkpt>", path.read_text(encoding="utf-8", errors="replace"), re.DOTALL):
        with contextlib.suppress(ParseError):
            point = None if part[0] == "<trk>" else _point(fromstring(part[0]))
            number += part[0] == "<trk>"
            if point is not None:
                found.setdefault(number, []).append(point)
    return found


def _point(element: Element) -> _Point | None:
    values = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in element}
    # Python 3.10 reads no Z, and no fractions of other than three or six digits.
    text = re.sub(r"(\.\d{1,6})\d*", lambda m: m[1].ljust(7, "0"), values.get("time", "")).replace("Z", "+00:00")
    try:
        time = datetime.datetime.fromisoformat(text)
        place = float(element.get("lat", "nan")), float(element.get("lon", "nan")), float(values.get("ele") or "nan")
    except ValueError:
        return None
    time = time if time.tzinfo else time.replace(tzinfo=datetime.timezone.utc)
    since = time - datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)
    return (round(since / datetime.timedelta(microseconds=1)) * 1000, place) if math.isfinite(place[0]) else None


FORMAT = LogFormat(".gpx", read_gpx, chooses=("track",))
