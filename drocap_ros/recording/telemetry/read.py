"""A telemetry log beside a video, whatever kept it: MAVLink .tlog, PX4 .ulg, ArduPilot .bin, DJI .srt."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.telemetry.camera_poses import VehicleTrack, interpolate

#: Clocks that the stamps of a log may count by.
UTC, BOOT, VIDEO = "utc", "boot", "video"
_SERIES_GAP_S = 1.0


class TelemetryLog(NamedTuple):
    """What a log tells.

    track : states by the log's clock, at the times of its attitude (DJI: of its subtitles)
    clock : "utc", "boot" (counted from power-up) or "video" (counted from the video's start)
    utc_minus_stamp_ns : what to add to a stamp for UTC; None where the log does not tell
    lacks : in words, what the log does not tell
    """

    kind: str
    track: VehicleTrack
    clock: str
    utc_minus_stamp_ns: int | None
    lacks: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Seconds from the first state to the last."""
        return float(self.track.stamp_ns[-1] - self.track.stamp_ns[0]) * 1e-9


def read_telemetry(path: str | Path) -> TelemetryLog:
    """Read a log; its kind is told by its first bytes, and by its suffix where those do not tell.

    Raises
    ------
    InputError
        When the file is missing, of no known kind, or tells no attitude and no position.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: expected a readable telemetry log; {error.strerror}") from None
    suffix = path.suffix.lower()
    if head.startswith(b"ULog\x01\x12\x35") or suffix == ".ulg":
        from drocap_ros.recording.telemetry.ulog import read_ulog as read
    elif head.startswith(b"\xa3\x95\x80") or suffix == ".bin":
        from drocap_ros.recording.telemetry.dataflash import read_dataflash as read
    elif suffix == ".srt":
        from drocap_ros.recording.telemetry.srt import read_srt as read
    elif suffix == ".tlog":
        from drocap_ros.recording.telemetry.tlog import read_tlog_track as read
    else:
        raise InputError(f"{path}: expected a telemetry log .tlog, .ulg, .bin or .srt, found another; check the path")
    return read(path)


def make_log(
    path: Path,
    kind: str,
    stamp_ns: np.ndarray,
    *,
    clock: str,
    orientation: np.ndarray | None = None,
    position: np.ndarray | None = None,
    gimbal: np.ndarray | None = None,
    utc_minus_stamp_ns: int | None = None,
    lacks: tuple[str, ...] = (),
) -> TelemetryLog:
    """Log from its series (N, ...) at ``stamp_ns``: stamps made increasing, what is missing NaN and told.

    Raises
    ------
    InputError
        When there is neither an attitude nor a position.
    """
    count = len(stamp_ns)
    order = np.argsort(stamp_ns, kind="stable")
    stamps = np.asarray(stamp_ns, np.int64)[order]
    fresh = np.concatenate([[True], np.diff(stamps) > 0]) if count else np.zeros(0, bool)

    def series(values: np.ndarray | None, size: int) -> np.ndarray:
        found = np.full((count, size), np.nan) if values is None else np.asarray(values, np.float64)
        return found[order][fresh]

    track = VehicleTrack(stamps[fresh], series(position, 3), _unit(series(orientation, 4)), _unit(series(gimbal, 4)))
    told = {
        "gimbal or camera attitude": track.gimbal,
        "vehicle attitude": track.orientation,
        "position": track.position,
    }
    missing = [name for name, values in told.items() if not np.isfinite(values).all(axis=1).any()]
    if len(missing) == len(told):
        raise InputError(f"{path}: expected attitude or position in the {kind}, found neither; check the log")
    return TelemetryLog(kind, track, clock, utc_minus_stamp_ns, (*(f"no {name}" for name in missing), *lacks))


def at_stamps(known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool) -> np.ndarray:
    """One series of a log (N, C) at the times (F,) of another, NaN across gaps of more than a second."""
    order = np.argsort(known_ns, kind="stable")
    known_ns, values = known_ns[order], np.asarray(values, np.float64)[order]
    fresh = np.concatenate([[True], np.diff(known_ns) > 0])
    found, _ = interpolate(known_ns[fresh], values[fresh], stamp_ns, spherical=spherical, max_gap_s=_SERIES_GAP_S)
    return found


def _unit(quaternions: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.where(np.abs(length - 1.0) < 0.1, quaternions / np.where(length > 0, length, 1.0), np.nan)
