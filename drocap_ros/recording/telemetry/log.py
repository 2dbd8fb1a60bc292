"""A telemetry log as states of the vehicle, the same for every format."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import unit_quaternions

#: Width in mm of a 4:3 sensor with the diagonal of 35 mm film, to which equivalent focal lengths refer.
_EQUIVALENT_WIDTH_MM = 0.8 * math.hypot(36.0, 24.0)
#: 35 mm equivalent of the main camera of most DJI drones, in mm; see the models of ``djmd_layouts.py``.
_USUAL_MM = 24.0


class VehicleTrack(NamedTuple):
    """States of a vehicle at N times.

    stamp_ns : (N,) int64, strictly increasing
    position : (N, 3) m ENU, NaN unknown
    orientation : (N, 4) x y z w body FLU -> ENU, NaN unknown
    gimbal : (N, 4) x y z w camera FLU -> ENU, NaN without a mount
    """

    stamp_ns: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    gimbal: np.ndarray


class Lens(NamedTuple):
    """A lens as a file describes it; by default that of an unknown model, the usual main camera.

    focal_35mm_mm : focal length, 35 mm equivalent (of the sensor's diagonal)
    origin : text, where it comes from and what is assumed
    zoom : digital zoom
    """

    focal_35mm_mm: float = _USUAL_MM
    origin: str = f"{_USUAL_MM:g} mm equivalent assumed, as of most DJI main cameras"
    zoom: float = 1.0

    def __str__(self) -> str:
        return self.origin if self.zoom == 1.0 else f"{self.origin}, digital zoom {self.zoom:g}"

    def horizontal_fov_deg(self, size: tuple[int, int]) -> float:
        """Field of view across images of ``size`` (width, height) that use the longer side of a 4:3 sensor in full."""
        focal_px = max(size) * self.focal_35mm_mm / _EQUIVALENT_WIDTH_MM * self.zoom
        return math.degrees(2 * math.atan(0.5 * size[0] / focal_px))


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
    SLOW = "its dates run {} times slower than the video, slow motion: --rate HZ gives the images' true rate"
    ZOOM = "the zoom changes ({}): one camera matrix cannot hold it, so the camera is taken as unknown"


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
    utc_minus_stamp_ns: int | None = None
    lacks: tuple[LogLack, ...] = ()
    video_clock: bool = False
    video_parts: tuple[tuple[int, int], ...] = ()
    lens: Lens | None = None

    @property
    def duration_s(self) -> float:
        """Seconds from the first state to the last."""
        return float(self.track.stamp_ns[-1] - self.track.stamp_ns[0]) * 1e-9


class LogFormat(NamedTuple):
    """A format of telemetry; each reader's module registers its own in ``read.py``.

    suffix : of the name of a log beside a video; empty = the telemetry is inside the video
    magic, at : bytes by which the content is known, and their place within the first sixteen; empty = the name alone
    read : reader of a file of this format
    """

    suffix: str
    read: Callable[[Path], TelemetryLog]
    magic: bytes = b""
    at: int = 0

    def begins(self, head: bytes) -> bool:
        """Whether the first bytes of a file are of this format."""
        return bool(self.magic) and head[self.at :].startswith(self.magic)


def make_log(
    path: Path,
    kind: str,
    stamp_ns: np.ndarray,
    lacks: list[LogLack],
    *,
    orientation: np.ndarray | None = None,
    position: np.ndarray | None = None,
    gimbal: np.ndarray | None = None,
) -> TelemetryLog:
    """Log from its series (N, ...) at ``stamp_ns``; states are sorted, missing series are NaN and listed as lacks."""
    count = len(stamp_ns)
    order = np.argsort(stamp_ns, kind="stable")
    stamps = np.asarray(stamp_ns, np.int64)[order]
    fresh = np.concatenate([[True], np.diff(stamps) > 0]) if count else np.zeros(0, bool)

    def series(values: np.ndarray | None, size: int) -> np.ndarray:
        found = np.full((count, size), np.nan) if values is None else np.asarray(values, np.float64)
        return np.asarray(found[order][fresh])

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
    return TelemetryLog(kind, track, lacks=(*missing, *lacks))
