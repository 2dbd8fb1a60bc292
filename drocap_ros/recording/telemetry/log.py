"""A telemetry log as states of the vehicle, the same for every format."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.frames import orientation_to_ros, quaternion_from_euler
from drocap_ros.geometry.interpolation import interpolate
from drocap_ros.geometry.rotations import unit_quaternions
from drocap_ros.recording.telemetry.lens import Lens
from drocap_ros.recording.telemetry.vehicle_track import VehicleTrack

_SERIES_GAP_S = 1.0


class Lack(Enum):
    """A limitation of a log; the value is its text, ``{}`` stands for :attr:`LogLack.detail`."""

    CAMERA_ATTITUDE = "no gimbal or camera attitude in the log"
    VEHICLE_ATTITUDE = "no vehicle attitude in the log"
    POSITION = "no position in the log"
    LOCAL_POSITION = "no valid local position in the log: positions are relative to the first of {}"
    HEIGHT = "no height above take-off in the log: heights are relative to the first {}"
    MOUNT_YAW = "no yaw of the mount relative to north in the log ({})"
    DROPOUTS = "{} dropouts in the log: parts of the flight are missing"
    DAMAGED = "the log is damaged: read up to the damage"
    DAMAGED_STATES = "{} of the states are damaged: left out"
    AIRCRAFT_ZERO = "the aircraft's angles are zero throughout: left out"
    QUATERNION = "the gimbal's quaternion contradicts its angles: the angles are used"
    ZOOM = "the digital zoom changes ({}): one camera matrix cannot hold it"


class LogLack(NamedTuple):
    """One limitation of a log."""

    kind: Lack
    detail: str = ""

    def __str__(self) -> str:
        return self.kind.value.format(self.detail)


class TelemetryLog(NamedTuple):
    """States of the vehicle from a log.

    track : states by the log's clock, at the times of its attitude (DJI: of its subtitles)
    utc_minus_stamp_ns : added to a stamp gives UTC; None where unknown
    lacks : limitations of the log
    video_clock : whether stamps start with the video
    video_parts : (first, last) stamp ns of each part during which the camera recorded; () = unknown
    lens : of the camera, None = unknown
    """

    kind: str
    track: VehicleTrack
    utc_minus_stamp_ns: int | None
    lacks: tuple[LogLack, ...] = ()
    video_clock: bool = False
    video_parts: tuple[tuple[int, int], ...] = ()
    lens: Lens | None = None

    @property
    def duration_s(self) -> float:
        """Seconds from the first state to the last."""
        return float(self.track.stamp_ns[-1] - self.track.stamp_ns[0]) * 1e-9


def make_log(
    path: Path,
    kind: str,
    stamp_ns: np.ndarray,
    *,
    orientation: np.ndarray | None = None,
    position: np.ndarray | None = None,
    gimbal: np.ndarray | None = None,
    utc_minus_stamp_ns: int | None = None,
    lacks: tuple[LogLack, ...] = (),
    video_clock: bool = False,
    video_parts: tuple[tuple[int, int], ...] = (),
    lens: Lens | None = None,
) -> TelemetryLog:
    """Log from its series (N, ...) at ``stamp_ns``; states are sorted, missing series are NaN and listed as lacks.

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

    track = VehicleTrack(
        stamps[fresh],
        series(position, 3),
        unit_quaternions(series(orientation, 4)),
        unit_quaternions(series(gimbal, 4)),
    )
    found = {
        Lack.CAMERA_ATTITUDE: track.gimbal,
        Lack.VEHICLE_ATTITUDE: track.orientation,
        Lack.POSITION: track.position,
    }
    missing = [LogLack(lack) for lack, values in found.items() if not np.isfinite(values).all(axis=1).any()]
    if len(missing) == len(found):
        raise InputError(f"{path}: expected attitude or position in the {kind}, found neither; check the log")
    return TelemetryLog(kind, track, utc_minus_stamp_ns, (*missing, *lacks), video_clock, video_parts, lens)


def dji_attitude(pitch_roll_yaw_deg: np.ndarray) -> np.ndarray:
    """(N, 4) x y z w FLU -> ENU of DJI's angles (N, 3): pitch positive up, yaw clockwise from north."""
    pitch, roll, yaw = np.deg2rad(pitch_roll_yaw_deg).T
    return orientation_to_ros(quaternion_from_euler(roll, pitch, yaw).T)


def at_stamps(known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool) -> np.ndarray:
    """One series of a log (N, C) at the times (F,) of another, NaN across gaps of more than a second."""
    order = np.argsort(known_ns, kind="stable")
    known_ns, values = known_ns[order], np.asarray(values, np.float64)[order]
    fresh = np.concatenate([[True], np.diff(known_ns) > 0])
    found, _ = interpolate(known_ns[fresh], values[fresh], stamp_ns, spherical=spherical, max_gap_s=_SERIES_GAP_S)
    return found
