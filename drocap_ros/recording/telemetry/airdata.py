"""States of the camera from a flight log that Airdata (https://airdata.com) exports as CSV, ten rows a second."""

from __future__ import annotations

import csv
import math
from datetime import datetime, timezone
from pathlib import Path
from typing import IO

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.recording.telemetry.log import Lens, LogFormat, TelemetryLog, dji_attitude, from_first_fix, make_log
from drocap_ros.recording.telemetry.plausibility import Series, plausible

TIME = "time(millisecond)"
#: Characters of a line, beyond which the file is no table: Airdata's lines have about a thousand.
_LINE = 16384
#: Rows: five hours at Airdata's ten a second.
_MAX_ROWS = 200_000
#: A later time than eleven days is damage.
_LATEST_MS = 1e9
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
            table = _Table(path, file)
    except OSError as error:
        raise InputError(f"{path}: expected a readable file; {error.strerror}") from None
    except csv.Error as error:
        raise InputError(f"{path}: expected a CSV file of Airdata; {error}") from None
    stamp_ns = np.round(table.columns(TIME)[:, 0] * 1e6).astype(np.int64)
    gimbal = table.columns(*_GIMBAL)
    if not table.has(_GIMBAL[1]):
        gimbal[:, 1] = 0.0  # older exports have no roll
    geodetic = np.column_stack([table.columns(*_PLACE), table.height_m()])
    found, lacks = plausible(path, Series(stamp_ns, gimbal, table.columns(*_AIRCRAFT), geodetic))
    utc_s = table.columns(_UTC)[:, 0] - stamp_ns * 1e-9
    video = true_runs(table.columns(_VIDEO)[:, 0] == 1)
    return make_log(
        path,
        "Airdata CSV",
        stamp_ns,
        lacks,
        orientation=dji_attitude(found.aircraft),
        position=from_first_fix(found.geodetic, above_takeoff=True),
        gimbal=dji_attitude(found.gimbal),
    )._replace(
        # The column has whole seconds.
        utc_minus_stamp_ns=round((float(np.nanmedian(utc_s)) + 0.5) * 1e9) if np.isfinite(utc_s).any() else None,
        video_parts=tuple((int(stamp_ns[a]), int(stamp_ns[b - 1])) for a, b in video),
        lens=Lens(),
    )


class _Table:
    """Rows of a file at times that increase; a column that is not there is NaN."""

    def __init__(self, path: Path, file: IO[str]) -> None:
        reader = csv.reader(iter(lambda: file.readline(_LINE), ""))
        head = [name.strip().lower() for name in next(reader, [])]
        _check_head(path, head)
        self._names = [name for name in _USED if name in head]
        read = [(head.index(name), _utc_s if name == _UTC else _number) for name in self._names]
        rows: list[list[float]] = []
        for row in reader:
            if len(rows) >= _MAX_ROWS:
                raise InputError(f"{path}: expected at most {_MAX_ROWS} rows, found more; cut the file")
            rows.append([number(row[i]) if i < len(row) else math.nan for i, number in read])
        table: np.ndarray = np.array(rows, dtype=np.float64).reshape(-1, len(read))
        time_ms = table[:, self._names.index(TIME)]
        table = table[(time_ms >= 0) & (time_ms < _LATEST_MS)]
        self._rows = table[np.unique(table[:, self._names.index(TIME)], return_index=True)[1]]
        if not len(self._rows):
            raise InputError(f"{path}: expected rows with {TIME}, found none; export the flight from Airdata again")

    def has(self, name: str) -> bool:
        return name in self._names

    def columns(self, *names: str) -> np.ndarray:
        unknown = np.full(len(self._rows), np.nan)
        return np.stack([self._rows[:, self._names.index(n)] if self.has(n) else unknown for n in names], axis=1)

    def height_m(self) -> np.ndarray:
        """(N, 1) above take-off, in the unit that the file has."""
        unit = next((unit for unit in _UNITS_M if self.has(_HEIGHT + unit)), "(meters)")
        return self.columns(_HEIGHT + unit) * _UNITS_M[unit]


def _check_head(path: Path, head: list[str]) -> None:
    if TIME not in head:
        raise InputError(f"{path}: expected a flight log of Airdata with the column {TIME}, found another; check it")
    if not any(_HEIGHT + unit in head for unit in _UNITS_M) and any(name.startswith(_HEIGHT) for name in head):
        raise InputError(f"{path}: expected {_HEIGHT} in (feet) or (meters), found another unit; export it again")


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


FORMAT = LogFormat(".csv", read_airdata)
