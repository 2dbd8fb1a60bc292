"""States of the camera from a flight log as CSV: of Airdata (https://airdata.com), ten rows a second, of Litchi, or a
DJI flight record as its readers export it; also as a spreadsheet saves it, with semicolons or as UTF-16.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import math
import re
from collections.abc import Collection
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.recording.telemetry.log import (
    Lack,
    LogFormat,
    LogLack,
    Series,
    TelemetryLog,
    dji_attitude,
    from_first_fix,
    lens_of_views,
    make_log,
    plausible,
)
from drocap_ros.recording.text import rows_of

#: Rows: five hours at Airdata's ten a second.
_MAX_ROWS = 200_000
_GIMBAL, _AIRCRAFT = ("gimbal pitch", "gimbal roll", "gimbal yaw"), ("pitch", "roll", "yaw")
#: A column's title in lower case: its name, and its unit in brackets.
_TITLE = re.compile(r"([^(\[]*[^(\[ ]) *(?:[(\[]([^)\]]*)[)\]])?")
#: A flight record's time as text.
_FLY_TIME = re.compile(r"(?:(\d{1,3})h *)?(?:(\d{1,4})m *)?(\d{1,4}(?:\.\d{1,6})?)s")
_Units = dict[str, float]
_MS: _Units = {"millisecond": 1.0, "milliseconds": 1.0, "ms": 1.0, **dict.fromkeys(("s", "sec", "seconds"), 1000.0)}
_M: _Units = {**dict.fromkeys(("m", "meter", "meters", "metres"), 1.0), **dict.fromkeys(("ft", "feet"), 0.3048)}
_DEG: _Units = {**dict.fromkeys(("", "deg", "degrees", "°", "360"), 1.0), "rad": math.degrees(1.0)}
_PLAIN: _Units = {"": 1.0}
#: Name of a column -> ours, and its possible units in ours: ms, deg, m.  A flight record without units has s and m.
_COLUMNS: dict[str, tuple[str, _Units]] = {
    "time": ("time", _MS), "osd.flytime": ("time", {"": 1000.0, **_MS}), "datetime": ("utc", {"utc": 1.0}),
    "isvideo": ("video", _PLAIN), "camera.isvideo": ("video", _PLAIN), "height_above_takeoff": ("height", _M),
    **{f"{before}{name}": (name, _DEG) for before in ("", "osd.") for name in ("latitude", "longitude")},
    "osd.height": ("height", {"": 1.0, **_M}), "altitude": ("height", _M), "compass_heading": ("yaw", _DEG),
    "gimbal_heading": ("gimbal yaw", _DEG),
    **{f"{before}{a}": (a, _DEG) for a in _AIRCRAFT for before in ("", "osd.")},
    **{f"{before}{a}": (f"gimbal {a}", _DEG) for a in _AIRCRAFT for before in ("gimbal_", "gimbal.")},
    **dict.fromkeys(("fov_h", "hfov", "camera_fov", "camera.fov", "horizontal_fov"), ("view", _DEG)),
    **{f"gimbal{a}raw": (f"gimbal {a}", {"": 0.1}) for a in _AIRCRAFT},
}  # fmt: skip


def read_airdata(path: Path) -> TelemetryLog:
    """Gimbal, aircraft and position by time since the start of the log, and the parts that are on video (isVideo)."""
    try:
        table = _Table(path)
    except (csv.Error, UnicodeError) as error:
        raise InputError(f"{path}: expected a readable flight log as CSV; {first_line(error)}") from None
    stamp_ns = np.round(table.columns("time")[:, 0] * 1e6).astype(np.int64)
    gimbal = table.columns(*_GIMBAL)
    if not table.has(_GIMBAL[1]):
        gimbal[:, 1] = 0.0  # older exports have no roll
    geodetic = table.columns("latitude", "longitude", "height")
    found, lacks = plausible(path, Series(stamp_ns, gimbal, table.columns(*_AIRCRAFT), geodetic))
    utc_s = table.columns("utc")[:, 0] - stamp_ns * 1e-9
    lens, zoom = lens_of_views(table.columns("view")[:, 0], "as the log states")
    lacks += [*zoom, *table.lacks]
    video = true_runs(table.columns("video")[:, 0] == 1)
    body, camera = dji_attitude(found.aircraft), dji_attitude(found.gimbal)
    place = from_first_fix(found.geodetic, above_takeoff=True)
    log = make_log(path, table.kind, stamp_ns, lacks, orientation=body, position=place, gimbal=camera)
    return log._replace(
        # The column has whole seconds.
        utc_minus_stamp_ns=round((float(np.nanmedian(utc_s)) + 0.5) * 1e9) if np.isfinite(utc_s).any() else None,
        video_parts=tuple((int(stamp_ns[a]), int(stamp_ns[b - 1])) for a, b in video),
        lens=lens,
    )


class _Table:
    """Rows of a file at times that increase; a column that is not there is NaN."""

    def __init__(self, path: Path) -> None:
        cells = rows_of(path)
        head = [name.strip().lower() for name in next(cells, [])]
        found: dict[str, tuple[int, float]] = {}
        for i, title in enumerate(head):
            if column := _column(title):
                found.setdefault(column[0], (i, column[1]))
        _check_head(path, head, found)
        record = "flight record CSV" if "osd.yaw" in head else "Airdata CSV"
        self.kind = "Litchi CSV" if "gimbalpitchraw" in head else record
        self._names = list(found)
        rows = [_row(row, found) for row in itertools.islice(cells, _MAX_ROWS + 1)]
        if len(rows) > _MAX_ROWS:
            raise InputError(f"{path}: expected at most {_MAX_ROWS} rows, found more; cut the file")
        table: np.ndarray = np.array(rows, dtype=np.float64).reshape(-1, len(found))
        time_ms = table[:, self._names.index("time")]
        # A later time than eleven days is damage.
        table = table[(time_ms >= 0) & (time_ms < 1e9)]
        at, self.lacks = self._names.index("time"), list[LogLack]()
        # Where the time begins anew another flight does.
        flights = np.split(table, np.flatnonzero(np.diff(table[:, at]) < -1000) + 1)
        if 1 < len(flights) < len(table) / 10:
            table = max(flights, key=len)
            words = f"flights in the log, of {', '.join(map(str, map(len, flights)))} rows: the longest is used"
            self.lacks.append(LogLack(Lack.SEVERAL, words))
        self._rows = table[np.unique(table[:, at], return_index=True)[1]]
        if not len(self._rows):
            raise InputError(f"{path}: expected rows with a time, found none; export the flight again")

    def has(self, name: str) -> bool:
        return name in self._names

    def columns(self, *names: str) -> np.ndarray:
        rows = np.pad(self._rows, ((0, 0), (0, 1)), constant_values=np.nan)  # the last column is the unknown one
        return rows[:, [self._names.index(name) if self.has(name) else -1 for name in names]]


def _column(title: str) -> tuple[str, float] | None:
    """Our name of a column and its unit in ours, None where it is another column or unit."""
    match = _TITLE.fullmatch(title)
    name, units = _COLUMNS.get(match[1], ("", _PLAIN)) if match else ("", _PLAIN)
    unit = units.get((match[2] or "") if match else "")
    return (name, unit) if name and unit else None


def _row(cells: list[str], columns: dict[str, tuple[int, float]]) -> list[float]:
    """Numbers of a row by the places and units of the columns; NaN where it ends before."""
    texts = ((name, unit, cells[i] if i < len(cells) else "") for name, (i, unit) in columns.items())
    return [(_utc_s if name == "utc" else _number)(text) * unit for name, unit, text in texts]


def _check_head(path: Path, head: list[str], found: Collection[str]) -> None:
    if "time" not in found:
        raise InputError(f"{path}: expected a log of Airdata, Litchi or DJI, found no column of its time; check it")
    if "height" not in found and any(name.startswith(("height_above", "osd.height", "altitude")) for name in head):
        raise InputError(f"{path}: expected heights in feet or meters, found another unit; export it again")


def _number(text: str) -> float:
    text = text.strip().lower()
    if time := _FLY_TIME.fullmatch(text):
        return 3600.0 * float(time[1] or 0) + 60.0 * float(time[2] or 0) + float(time[3])
    try:
        value = float({"true": "1", "false": "0"}.get(text, text))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _utc_s(text: str) -> float:
    """Time of a date, whose year a spreadsheet may have put last, behind the day."""
    year_first = re.sub(r"^(\d\d?)\.(\d\d?)\.(\d{4})", r"\3-\2-\1", text.strip()).replace("/", "-").replace("T", " ")
    for form in ("%Y-%m-%d %H:%M:%S", "%Y-%m-%d %H:%M:%S.%f", "%Y-%m-%d %H:%M"):
        with contextlib.suppress(ValueError, OverflowError):
            return datetime.strptime(year_first.removesuffix("Z"), form).replace(tzinfo=timezone.utc).timestamp()
    return math.nan


FORMAT = LogFormat(".csv", read_airdata)
