"""A telemetry log as states of the vehicle, the same for every format."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import camera_rotation, orientation_to_ros, quaternion_from_euler
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.geometry.interpolation import interpolate, true_runs, without_steps
from drocap_ros.geometry.rotations import quaternion_multiply, unit_quaternions
from drocap_ros.tracks import Tracks

#: Kind of a receiver's fix in three dimensions, by PX4, ArduPilot and GoPro; more are better ones.
FIX_3D = 3
#: Interpolation over longer gaps than this is reported.
REPORTED_GAP_S = 1.0
#: Share of the images that must have a pose; with fewer the telemetry is left out, not the images.
MIN_SHARE = 0.5


class CameraPoses(NamedTuple):
    """Camera poses of the images that stay.

    rotation : (F, 3, 3) world ENU -> optical, or None
    position : (F, 3) m, or None
    keep : index of the images that stay, one slice where they follow each other; the others have no telemetry
    reason : text, what is missing or was left out
    """

    rotation: np.ndarray | None
    position: np.ndarray | None
    keep: slice | np.ndarray
    reason: str


def camera_attitude(track: VehicleTrack, mount_pitch_deg: float | None = None) -> np.ndarray:
    """(N, 4) x y z w camera FLU -> ENU of each state: the gimbal's.

    Without a gimbal, ``mount_pitch_deg`` (negative = down) gives the attitude of a camera fixed to the body; without
    either all is NaN.
    """
    if mount_pitch_deg is None or np.isfinite(track.gimbal).all(axis=1).any():
        return track.gimbal
    # FLU: positive about y (left) turns the nose down.
    return quaternion_multiply(track.orientation, quaternion_from_euler(0.0, -np.deg2rad(mount_pitch_deg), 0.0))


def camera_poses(track: VehicleTrack, stamp_ns: np.ndarray, mount_pitch_deg: float | None = None) -> CameraPoses:
    """Camera pose at the stamps (F,) of images: attitude on SO(3), position linearly, by :func:`interpolate`.

    Images without a pose are left out where at least half of the images have poses; else all images stay, without
    telemetry.
    """
    attitude = camera_attitude(track, mount_pitch_deg)
    missing = "gimbal" if mount_pitch_deg is None else "attitude"
    keep, place = np.ones(len(stamp_ns), bool), _without_steps(track, stamp_ns)
    rotation, keep, reasons = _series(track.stamp_ns, attitude, stamp_ns, keep, missing, spherical=True)
    position, keep, more = _series(track.stamp_ns, place, stamp_ns, keep, "position", spherical=False)
    runs = true_runs(keep)
    return CameraPoses(
        None if rotation is None else camera_rotation(rotation[keep]),
        None if position is None else position[keep],
        slice(*runs[0].tolist()) if len(runs) == 1 else keep,
        "; ".join(reasons + more),
    )


def with_camera(
    tracks: Tracks, vehicle: VehicleTrack, at_ns: np.ndarray, mount_pitch_deg: float | None = None
) -> tuple[Tracks, str]:
    """Tracks with the camera's pose at each image, and as text what is missing; see :func:`camera_poses`.

    at_ns : (F,) times of the images by the clock of the vehicle's states
    """
    poses = camera_poses(vehicle, at_ns, mount_pitch_deg)
    kept = dataclasses.replace(tracks, camera_rotation=None, camera_position=None).of_frames(poses.keep)
    changed = dataclasses.replace(kept, camera_rotation=poses.rotation, camera_position=poses.position)
    return changed, poses.reason


def _without_steps(track: VehicleTrack, stamp_ns: np.ndarray) -> np.ndarray:
    """(N, 3) m: the track's positions about the time of the images, without the steps in which they are reported.

    Interpolated at the images, steps would no longer stand alone.
    """
    place, reach_ns = track.position.copy(), round(REPORTED_GAP_S * 1e9)
    if len(stamp_ns):
        about = (track.stamp_ns >= stamp_ns[0] - reach_ns) & (track.stamp_ns <= stamp_ns[-1] + reach_ns)
        about &= np.isfinite(place).all(axis=1)
        if about.any():
            place[about] = without_steps(place[about], track.stamp_ns[about])
    return place


def _series(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, keep: np.ndarray, name: str, *, spherical: bool
) -> tuple[np.ndarray | None, np.ndarray, list[str]]:
    """Values at the images, those of the images ``keep`` (F,) that have one, and what is missing, in words."""
    if not np.isfinite(values).all(axis=1).any() or not len(stamp_ns):
        return None, keep, [f"the states of the vehicle hold no {name}"]
    word = "attitude" if spherical else name
    found, gap_s = interpolate(known_ns, values, stamp_ns, spherical=spherical)
    known = keep & np.isfinite(found).all(axis=1)
    article = "an" if word[0] in "aeiou" else "a"
    if known.sum() < MIN_SHARE * len(stamp_ns):
        return None, keep, [f"images are up to {gap_s[keep].max():.1f} s from {article} {word}"]
    words = []
    first, last = np.flatnonzero(known)[[0, -1]]
    lost = keep & ~known
    in_gaps = lost.copy()
    in_gaps[:first] = in_gaps[last:] = False
    at_ends = lost & ~in_gaps
    if at_ends.any():
        far = f"up to {gap_s[at_ends].max():.1f} s from {article} {word}"
        words.append(f"{at_ends.sum()} images at the start or end are {far}: left out")
    if in_gaps.any():
        words.append(f"{in_gaps.sum()} images in gaps of the {word} of up to {gap_s[in_gaps].max():.1f} s: left out")
    if gap_s[known].max() > REPORTED_GAP_S:
        words.append(f"the {word} was interpolated over gaps of up to {gap_s[known].max():.1f} s")
    return found, known, words


def dji_attitude(pitch_roll_yaw_deg: np.ndarray) -> np.ndarray:
    """(N, 4) x y z w FLU -> ENU of DJI's angles (N, 3): pitch positive up, yaw clockwise from north."""
    pitch, roll, yaw = np.deg2rad(pitch_roll_yaw_deg).T
    return orientation_to_ros(quaternion_from_euler(roll, pitch, yaw).T)


def from_first_fix(geodetic: np.ndarray, *, above_takeoff: bool = False) -> np.ndarray | None:
    """(N, 3) m ENU of latitude deg, longitude deg and height m from the first state that has all; None without one.

    Heights above take-off stay as they are.
    """
    fixed = np.isfinite(geodetic).all(axis=1)
    if not fixed.any():
        return None
    origin = geodetic[fixed][0].copy()
    if above_takeoff:
        origin[2] = 0.0
    return geodetic_to_enu(geodetic, origin)


def at_stamps(known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool) -> np.ndarray:
    """One series of a log (N, C) at the times (F,) of another, NaN across gaps of more than a second."""
    order = np.argsort(known_ns, kind="stable")
    known_ns, values = known_ns[order], np.asarray(values, np.float64)[order]
    fresh = np.concatenate([[True], np.diff(known_ns) > 0])
    # Longest gap of one series of a log over which it is interpolated: ten periods of the slowest usual rate, 10 Hz.
    found, _ = interpolate(known_ns[fresh], values[fresh], stamp_ns, spherical=spherical, max_gap_s=1.0)
    return found


#: Largest magnitudes of pitch, roll and yaw, deg.
_LIMITS_DEG = np.array([180.0, 180.0, 360.0])
#: Metres of a degree of latitude.
METRES_PER_DEG = 111_320.0


class Series(NamedTuple):
    """What a file gives at N times, NaN where unknown.

    stamp_ns : (N,) strictly increasing
    gimbal, aircraft : (N, 3) deg pitch (positive up), roll, yaw (clockwise from north)
    geodetic : (N, 3) latitude deg, longitude deg, height m
    """

    stamp_ns: np.ndarray
    gimbal: np.ndarray
    aircraft: np.ndarray
    geodetic: np.ndarray

    @staticmethod
    def of_places(stamp_ns: np.ndarray, geodetic: np.ndarray) -> Series:
        """Those of a file without attitudes."""
        unknown = np.full((len(geodetic), 3), np.nan)
        return Series(stamp_ns, unknown, unknown, geodetic)


def plausible(path: Path, series: Series) -> tuple[Series, list[LogLack]]:
    """The series without damaged states and places without a fix, and what was left out."""
    lacks: list[LogLack] = []
    gimbal, aircraft, place = (series[i].copy() for i in (1, 2, 3))
    place[(place[:, :2] == 0).all(axis=1)] = np.nan  # no fix
    limits = {"gimbal angles": (gimbal, _LIMITS_DEG), "aircraft angles": (aircraft, _LIMITS_DEG)}
    # Height, m, that no drone reaches.
    limits["positions"] = (place, np.array([90.0, 180.0, 20_000.0]))
    damaged = np.zeros(len(place), bool)
    for name, (values, limit) in limits.items():
        known = ~np.isnan(values).any(axis=1)
        wrong = known & ~(np.abs(values) <= limit).all(axis=1)
        # Largest share of states out of range that counts as damage, not as another meaning.
        if wrong.sum() > 0.02 * known.sum():
            found = ", ".join(f"{v:.6g}" for v in values[np.argmax(wrong)])
            _refuse(path, f"{name} within {', '.join(f'{v:g}' for v in limit)}", f"({found})")
        damaged |= wrong
        values[wrong] = np.nan
    if damaged.any():
        lacks.append(LogLack(Lack.DAMAGED_STATES, str(int(damaged.sum()))))
    if _zero(gimbal):
        _refuse(path, "the gimbal's angles", "zeros throughout, which means that they were not recorded")
    if _zero(aircraft):
        if np.isnan(gimbal).any(axis=1).all():
            _refuse(path, "the aircraft's angles", "zeros throughout, which means that they were not recorded")
        aircraft[:] = np.nan
        lacks.append(LogLack(Lack.AIRCRAFT_ZERO))
    _check_turns(path, "gimbal", series.stamp_ns, gimbal)
    _check_turns(path, "aircraft", series.stamp_ns, aircraft)
    _check_path(path, series.stamp_ns, place)
    return Series(series.stamp_ns, gimbal, aircraft, place), lacks


def _zero(angles: np.ndarray) -> bool:
    known = angles[~np.isnan(angles).any(axis=1)]
    # States from which zeros throughout mean that nothing was filled in.
    return len(known) >= 10 and not known.any()


def _check_turns(path: Path, name: str, stamp_ns: np.ndarray, angles: np.ndarray) -> None:
    known = ~np.isnan(angles).any(axis=1)
    turns = np.abs((np.diff(angles[known], axis=0) + 180.0) % 360.0 - 180.0).max(axis=1, initial=0.0)
    # No gimbal turns farther from one state to the next: DJI's are specified to turn by half of 360 deg/s.
    possible = 30.0 + 360.0 * np.diff(stamp_ns[known]) * 1e-9
    share = float(np.mean(turns > possible)) if len(turns) else 0.0
    # Largest share of such turns: angles jump where a gimbal is recentred.
    if share > 0.05:
        _refuse(path, f"{name} angles that turn steadily", f"{share:.0%} of them jump, by up to {turns.max():.0f} deg")


def _check_path(path: Path, stamp_ns: np.ndarray, place: np.ndarray) -> None:
    known = ~np.isnan(place).any(axis=1)
    if not known.any():
        return
    step = np.diff(place[known], axis=0)
    step[:, 1] = (step[:, 1] + 180.0) % 360.0 - 180.0
    scale = np.array([METRES_PER_DEG, METRES_PER_DEG * np.cos(np.deg2rad(place[known][0, 0])), 1.0])
    way = np.linalg.norm(step * scale, axis=1)
    # No drone flies farther: DJI's fastest have some 40 m/s, and a fix that is renewed moves a place by some metres.
    jumps = way > 20.0 + 60.0 * np.diff(stamp_ns[known]) * 1e-9
    if jumps.any():
        _refuse(path, "positions that a drone can fly", f"{jumps.sum()} jumps, the longest by {way.max():.0f} m")


def _refuse(path: Path, expected: str, found: str) -> None:
    raise InputError(f"{path}: expected {expected}, found {found}; --telemetry LOG names another source")


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

    @classmethod
    def of_view(cls, fov_deg: float, origin: str) -> Lens:
        """A lens by its horizontal field of view across the longer side of the image."""
        focal_mm = 0.5 * _EQUIVALENT_WIDTH_MM / math.tan(math.radians(0.5 * fov_deg))
        return cls(focal_mm, f"{fov_deg:g} deg across the image, {origin}")

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
    SEVERAL = "several {}"
    HEIGHT_UNKNOWN = "no height in the log: it is taken as constant"
    HEIGHT = "no height above take-off in the log: heights are relative to the first {}"
    MOUNT_YAW = "no yaw of the mount relative to north in the log ({})"
    DROPOUTS = "{} dropouts in the log: parts of the flight are missing"
    DAMAGED = "the log is damaged: {}"
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


def lens_of_views(view_deg: np.ndarray, origin: str) -> tuple[Lens | None, list[LogLack]]:
    """The lens of horizontal fields of view (N,) deg, the usual one where none is known; None and why if it changes."""
    stated = view_deg[(view_deg >= 5) & (view_deg <= 170)]
    if not len(stated):
        return Lens(), []
    if np.ptp(stated) > 0.01 * np.median(stated):
        return None, [LogLack(Lack.ZOOM, f"{stated.min():.0f} deg to {stated.max():.0f} deg")]
    return Lens.of_view(float(np.median(stated)), origin), []


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

    chooses : of what a log may hold several, as keywords of ``read``; the first is that of a name without a keyword
    suffix : of the name of a log beside a video; empty = the telemetry is inside the video
    magic, at : bytes by which the content is known, and their place within the first sixteen; empty = the name alone
    read : reader of a file of this format
    """

    suffix: str
    read: Callable[..., TelemetryLog]
    magic: bytes = b""
    at: int = 0
    chooses: tuple[str, ...] = ()

    def begins(self, head: bytes) -> bool:
        """Whether the first bytes of a file are of this format."""
        return bool(self.magic) and head[self.at :].startswith(self.magic)


def choose(path: Path, what: str, found: Mapping[str, int], wanted: str) -> tuple[str, list[LogLack]]:
    """The wanted one of several vehicles, mounts or tracks, else the first of those with most states; words on both.

    found : number of states of each
    """
    name = wanted or max(found, key=lambda each: found[each])
    if name not in found:
        raise InputError(f"{path}#{what}={name}: expected one of {', '.join(found)}, found another name; correct it")
    states = ", ".join(f"{each} ({count} states)" for each, count in found.items())
    words = f"{what}s in the log, {states}: {name} is used; {path.name}#{what}=NAME as LOG chooses another"
    return name, [LogLack(Lack.SEVERAL, words)] if len(found) > 1 else []


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
