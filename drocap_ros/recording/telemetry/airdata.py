"""States of the camera from a flight log that Airdata (https://airdata.com) exports as CSV, ten rows a second."""

from __future__ import annotations

import csv
import math
from datetime import datetime, timezone
from pathlib import Path
from typing import IO

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import geodetic_to_enu
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.recording.telemetry.lens import assumed_lens
from drocap_ros.recording.telemetry.log import TelemetryLog, dji_attitude, make_log
from drocap_ros.recording.telemetry.plausibility import Series, plausible

TIME = "time(millisecond)"
_LINE = 16384
_MAX_ROWS = 200_000  # five hours
_UNITS_M = {"(feet)": 0.3048, "(meters)": 1.0}
_HEIGHT = "height_above_takeoff"
_GIMBAL = ("gimbal_pitch(degrees)", "gimbal_roll(degrees)", "gimbal_heading(degrees)")
_AIRCRAFT = ("pitch(degrees)", "roll(degrees)", "compass_heading(degrees)")
_PLACE = ("latitude", "longitude")
_UTC, _VIDEO = "datetime(utc)", "isvideo"
_USED = (TIME, _UTC, *_PLACE, *(_HEIGHT + unit for unit in _UNITS_M), *_AIRCRAFT, *_GIMBAL, _VIDEO)


def read_airdata(path: Path) -> TelemetryLog:
    """Gimbal, aircraft and position by time since the start of the log, and the parts that are on video (isVideo).

    Raises
    ------
    InputError
        When the file cannot be read, lacks the columns of Airdata, or cannot be true.
    """
    try:
        with path.open("r", encoding="utf-8-sig", errors="replace", newline="") as file:
            head, rows = _table(path, file)
            table: np.ndarray = np.array(rows, dtype=np.float64).reshape(-1, len(head))
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror}") from None
    except csv.Error as error:
        raise InputError(f"{path}: expected a CSV file of Airdata; {error}") from None
    place = {name: i for i, name in enumerate(head)}
    time_ms = table[:, place[TIME]]
    table = table[(time_ms >= 0) & (time_ms < 1e9)]
    table = table[np.unique(table[:, place[TIME]], return_index=True)[1]]
    if not len(table):
        raise InputError(f"{path}: expected rows with {TIME}, found none; export the flight from Airdata again")
    stamp_ns = np.round(table[:, place[TIME]] * 1e6).astype(np.int64)

    def columns(names: tuple[str, ...], missing: float = np.nan) -> np.ndarray:
        return np.stack([table[:, place[n]] if n in place else np.full(len(table), missing) for n in names], axis=1)

    gimbal, aircraft = columns(_GIMBAL), columns(_AIRCRAFT)
    if _GIMBAL[1] not in place:
        gimbal[:, 1] = 0.0  # older exports have no roll
    height = next((table[:, place[_HEIGHT + u]] * f for u, f in _UNITS_M.items() if _HEIGHT + u in place), None)
    geodetic = np.column_stack([columns(_PLACE), np.full(len(table), np.nan) if height is None else height])
    found, lacks = plausible(path, Series(stamp_ns, gimbal, aircraft, geodetic))
    fixed = np.isfinite(found.geodetic).all(axis=1)
    position = None
    if fixed.any():
        position = geodetic_to_enu(found.geodetic, np.array([*found.geodetic[fixed][0, :2], 0.0]))
    utc_s = columns((_UTC,))[:, 0] - stamp_ns * 1e-9
    return make_log(
        path,
        "Airdata CSV",
        stamp_ns,
        orientation=dji_attitude(found.aircraft),
        position=position,
        gimbal=dji_attitude(found.gimbal),
        # The column has whole seconds.
        utc_minus_stamp_ns=round((float(np.nanmedian(utc_s)) + 0.5) * 1e9) if np.isfinite(utc_s).any() else None,
        lacks=tuple(lacks),
        video_parts=_parts(stamp_ns, columns((_VIDEO,), 0.0)[:, 0] == 1),
        lens=assumed_lens(),
    )


def _parts(stamp_ns: np.ndarray, video: np.ndarray) -> tuple[tuple[int, int], ...]:
    return tuple((int(stamp_ns[a]), int(stamp_ns[b - 1])) for a, b in true_runs(video))


def _table(path: Path, file: IO[str]) -> tuple[list[str], list[list[float]]]:
    """Names of the columns that are used, and their numbers row by row, NaN where there is none."""
    reader = csv.reader(iter(lambda: file.readline(_LINE), ""))
    head = [name.strip().lower() for name in next(reader, [])]
    if TIME not in head:
        raise InputError(f"{path}: expected a flight log of Airdata with the column {TIME}, found another; check it")
    if not any(_HEIGHT + unit in head for unit in _UNITS_M) and any(name.startswith(_HEIGHT) for name in head):
        raise InputError(f"{path}: expected {_HEIGHT} in (feet) or (meters), found another unit; export it again")
    used = [name for name in _USED if name in head]
    read = [(head.index(name), _utc_s if name == _UTC else _number) for name in used]
    rows: list[list[float]] = []
    for row in reader:
        if len(rows) >= _MAX_ROWS:
            raise InputError(f"{path}: expected at most {_MAX_ROWS} rows, found more; cut the file")
        rows.append([number(row[i]) if i < len(row) else math.nan for i, number in read])
    return used, rows


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _utc_s(text: str) -> float:
    try:
        return datetime.strptime(text.strip(), "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc).timestamp()
    except (ValueError, OverflowError):
        return math.nan
