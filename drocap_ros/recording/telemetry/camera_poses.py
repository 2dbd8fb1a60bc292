"""The camera's pose at each picture, from the recorded states of the vehicle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.frames import camera_rotation, quaternion_multiply
from drocap_ros.geometry.rotations import slerp

_NS = 1e-9
#: Longest time between two states over which the camera's pose is interpolated.
MAX_GAP_S = 2.0
#: From here on it is said that it was.
TELL_GAP_S = 1.0
#: Time beyond the first and last state for which these still hold; at 25 deg/s it is 2.5 deg.
HOLD_S = 0.1
#: Share of the pictures that must have a pose; with fewer the telemetry is left out, not the pictures.
MIN_SHARE = 0.5


class VehicleTrack(NamedTuple):
    """States of a vehicle over N instants.

    stamp_ns : (N,) int64, strictly increasing
    position : (N, 3) m ENU, NaN unknown
    orientation : (N, 4) x y z w body FLU -> ENU, NaN unknown
    gimbal : (N, 4) x y z w camera FLU -> ENU, NaN without a mount
    """

    stamp_ns: np.ndarray
    position: np.ndarray
    orientation: np.ndarray
    gimbal: np.ndarray


class CameraPoses(NamedTuple):
    """Camera pose of the pictures in ``keep``, of which every one has what is not None.

    rotation : (F, 3, 3) world ENU -> optical, or None
    position : (F, 3) m, or None
    keep : the pictures that stay; the others, at the start or end, have no telemetry
    reason : in words, what is missing or was left out
    """

    rotation: np.ndarray | None
    position: np.ndarray | None
    keep: slice
    reason: str


def camera_attitude(track: VehicleTrack, mount_pitch_deg: float | None = None) -> np.ndarray:
    """(N, 4) x y z w camera FLU -> ENU of each state: the gimbal's.

    Without one, a camera fixed to the body counts if its pitch is told (``mount_pitch_deg``, negative looks down);
    nothing is assumed: then all is NaN.
    """
    if mount_pitch_deg is None or np.isfinite(track.gimbal).all(axis=1).any():
        return track.gimbal
    half = -0.5 * np.deg2rad(mount_pitch_deg)  # FLU: positive about y (left) turns the nose down
    return quaternion_multiply(track.orientation, np.array([0.0, np.sin(half), 0.0, np.cos(half)]))


def camera_poses(track: VehicleTrack, stamp_ns: np.ndarray, mount_pitch_deg: float | None = None) -> CameraPoses:
    """Camera pose at the stamps (F,) of pictures: attitude on SO(3), position linearly between neighbouring states.

    A pose is not invented: a picture between two states more than ``MAX_GAP_S`` apart, or more than ``HOLD_S`` before
    the first or after the last, has none.  Where that leaves one stretch of at least half of the pictures, that
    stretch stays; else the pictures stay without telemetry.
    """
    attitude = camera_attitude(track, mount_pitch_deg)
    missing = "gimbal" if mount_pitch_deg is None else "attitude"
    keep, reasons = slice(0, len(stamp_ns)), []
    rotation, keep, words = _series(track.stamp_ns, attitude, stamp_ns, keep, missing, spherical=True)
    reasons += words
    position, keep, words = _series(track.stamp_ns, track.position, stamp_ns, keep, "position", spherical=False)
    reasons += words
    return CameraPoses(
        None if rotation is None else camera_rotation(rotation[keep]),
        None if position is None else position[keep],
        keep,
        "; ".join(reasons),
    )


def _series(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, keep: slice, name: str, *, spherical: bool
) -> tuple[np.ndarray | None, slice, list[str]]:
    if not np.isfinite(values).all(axis=1).any() or not len(stamp_ns):
        return None, keep, [f"the states of the vehicle tell no {name}"]
    word = "attitude" if spherical else name
    found, gap_s = interpolate(known_ns, values, stamp_ns, spherical=spherical)
    known = np.isfinite(found).all(axis=1)
    known[: keep.start] = known[keep.stop :] = False
    run = _longest_run(known)
    article = "an" if word[0] in "aeiou" else "a"
    worst_s = gap_s[keep].max()
    if run.stop - run.start < MIN_SHARE * len(stamp_ns):
        return None, keep, [f"pictures lie up to {worst_s:.1f} s from {article} {word}"]
    words = []
    left = (keep.stop - keep.start) - (run.stop - run.start)
    if left:
        words.append(f"{left} pictures at the start or end lie up to {worst_s:.1f} s from {article} {word}: left out")
    elif worst_s > TELL_GAP_S:
        words.append(f"the {word} was interpolated over gaps of up to {worst_s:.1f} s")
    return found, run, words


def interpolate(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool, max_gap_s: float = MAX_GAP_S
) -> tuple[np.ndarray, np.ndarray]:
    """Values (F, C) at the stamps (F,), NaN where they are not known, and the time (F,) s that they bridge.

    Rows of NaN among the known values (N, C) are passed over; ``spherical`` takes rows as quaternions.
    """
    good = np.isfinite(values).all(axis=1)
    if not good.any():
        return np.full((len(stamp_ns), values.shape[1]), np.nan), np.full(len(stamp_ns), np.inf)
    known_ns, values = known_ns[good], values[good]
    after = np.clip(np.searchsorted(known_ns, stamp_ns), 1, max(len(known_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(known_ns) - 1)
    inside = np.clip(stamp_ns, known_ns[0], known_ns[-1])
    span = known_ns[after] - known_ns[before]
    between = (inside == stamp_ns) & (stamp_ns != known_ns[before]) & (stamp_ns != known_ns[after])
    bridged_s = np.where(between, span, 0) * _NS
    beyond_s = np.abs(inside - stamp_ns) * _NS
    part = np.where(span > 0, (inside - known_ns[before]) / np.maximum(span, 1), 0.0)
    if spherical:
        found = slerp(values[before], values[after], part)
    else:
        found = values[before] + part[:, None] * (values[after] - values[before])
    unknown = (bridged_s > max_gap_s) | (beyond_s > HOLD_S)
    return np.where(unknown[:, None], np.nan, found), np.maximum(bridged_s, beyond_s)


def _longest_run(flags: np.ndarray) -> slice:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    if not len(starts):
        return slice(0, 0)
    best = int(np.argmax(stops - starts))
    return slice(int(starts[best]), int(stops[best]))
