"""States of the camera from a flight log as CSV: of Airdata (https://airdata.com), ten rows a second, of Litchi, or a
DJI flight record as its readers export it; also as a spreadsheet saves it, with semicolons or as UTF-16.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Collection, Iterator
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.recording.telemetry.log import Lens, LogFormat, TelemetryLog, make_log
from drocap_ros.recording.telemetry.plausibility import Series, plausible
from drocap_ros.recording.telemetry.series import dji_attitude, from_first_fix

#: Characters of a line, beyond which the file is no table: Airdata's lines have about a thousand.
_LINE = 16384
#: Rows: five hours at Airdata's ten a second.
_MAX_ROWS = 200_000
#: A later time than eleven days is damage.
_LATEST_MS = 1e9
_GIMBAL, _AIRCRAFT = ("gimbal pitch", "gimbal roll", "gimbal yaw"), ("pitch", "roll", "yaw")
#: Name of a column in lower case -> ours, and our unit of it: ms, deg, m.
_COLUMNS: dict[str, tuple[str, float]] = {
    "time(millisecond)": ("time", 1.0), "osd.flytime [s]": ("time", 1000.0),
    "datetime(utc)": ("utc", 1.0), "isvideo": ("video", 1.0), "camera.isvideo": ("video", 1.0),
    **{f"{before}{name}": (name, 1.0) for before in ("", "osd.") for name in ("latitude", "longitude")},
    "height_above_takeoff(feet)": ("height", 0.3048), "height_above_takeoff(meters)": ("height", 1.0),
    "osd.height [ft]": ("height", 0.3048), "osd.height [m]": ("height", 1.0), "altitude(m)": ("height", 1.0),
    "altitude(feet)": ("height", 0.3048), "compass_heading(degrees)": ("yaw", 1.0), "gimbal_heading(degrees)":
    ("gimbal yaw", 1.0), "yaw(deg)": ("yaw", 1.0), "osd.yaw": ("yaw", 1.0), "gimbal.yaw": ("gimbal yaw", 1.0),
    **{form.format(a): (a, 1.0) for a in ("pitch", "roll") for form in ("{}(degrees)", "{}(deg)", "osd.{}")},
    **{form.format(a): (f"gimbal {a}", 1.0) for a in ("pitch", "roll") for form in ("gimbal_{}(degrees)", "gimbal.{}")},
    **{f"gimbal{a}raw": (f"gimbal {a}", 0.1) for a in ("pitch", "roll", "yaw")},
}  # fmt: skip


def read_airdata(path: Path) -> TelemetryLog:
    """Gimbal, aircraft and position by time since the start of the log, and the parts that are on video (isVideo).

    Raises
    ------
    InputError
        When the file cannot be read, lacks the columns, or cannot be true.
    """
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
    video = true_runs(table.columns("video")[:, 0] == 1)
    body, camera = dji_attitude(found.aircraft), dji_attitude(found.gimbal)
    place = from_first_fix(found.geodetic, above_takeoff=True)
    log = make_log(path, table.kind, stamp_ns, lacks, orientation=body, position=place, gimbal=camera)
    return log._replace(
        # The column has whole seconds.
        utc_minus_stamp_ns=round((float(np.nanmedian(utc_s)) + 0.5) * 1e9) if np.isfinite(utc_s).any() else None,
        video_parts=tuple((int(stamp_ns[a]), int(stamp_ns[b - 1])) for a, b in video),
        lens=Lens(),
    )


class _Table:
    """Rows of a file at times that increase; a column that is not there is NaN."""

    def __init__(self, path: Path) -> None:
        cells = _cells(path)
        head = [name.strip().lower() for name in next(cells, [])]
        found: dict[str, tuple[int, float]] = {}
        for i, (name, unit) in ((i, _COLUMNS[title]) for i, title in enumerate(head) if title in _COLUMNS):
            found.setdefault(name, (i, unit))
        _check_head(path, head, found)
        record = "flight record CSV" if "osd.yaw" in head else "Airdata CSV"
        self.kind = "Litchi CSV" if "gimbalpitchraw" in head else record
        self._names = list(found)
        rows = [_row(row, found) for row in itertools.islice(cells, _MAX_ROWS + 1)]
        if len(rows) > _MAX_ROWS:
            raise InputError(f"{path}: expected at most {_MAX_ROWS} rows, found more; cut the file")
        table: np.ndarray = np.array(rows, dtype=np.float64).reshape(-1, len(found))
        time_ms = table[:, self._names.index("time")]
        table = table[(time_ms >= 0) & (time_ms < _LATEST_MS)]
        self._rows = table[np.unique(table[:, self._names.index("time")], return_index=True)[1]]
        if not len(self._rows):
            raise InputError(f"{path}: expected rows with a time, found none; export the flight again")

    def has(self, name: str) -> bool:
        return name in self._names

    def columns(self, *names: str) -> np.ndarray:
        rows = np.pad(self._rows, ((0, 0), (0, 1)), constant_values=np.nan)  # the last column is the unknown one
        return rows[:, [self._names.index(name) if self.has(name) else -1 for name in names]]


def _cells(path: Path) -> Iterator[list[str]]:
    """Rows as text, numbers with a point; a spreadsheet of some countries writes semicolons and decimal commas."""
    with path.open("rb") as file:
        wide = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    with path.open("r", encoding="utf-16" if wide else "utf-8-sig", errors="replace", newline="") as text:
        first = text.readline(_LINE)
        lines = itertools.chain([first], iter(lambda: text.readline(_LINE), ""))
        if first.count(";") <= first.count(","):
            yield from csv.reader(lines)
            return
        for row in csv.reader(lines, delimiter=";"):
            yield [cell.replace(",", ".") for cell in row]


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
    try:
        value = float({"true": "1", "false": "0"}.get(text.strip().lower(), text))
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _utc_s(text: str) -> float:
    try:
        return datetime.strptime(text.strip(), "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc).timestamp()
    except (ValueError, OverflowError):
        return math.nan


FORMAT = LogFormat(".csv", read_airdata)
