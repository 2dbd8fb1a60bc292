"""The camera's pose at each picture, from the recorded states of the vehicle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.frames import camera_rotation, quaternion_multiply
from drocap_ros.geometry.rotations import slerp

_NS = 1e-9
#: Longest time between two states over which the camera's pose is interpolated.
MAX_GAP_S = 1.0


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
    """Per picture: rotation (F, 3, 3) world ENU -> optical and position (F, 3) m, each None where it is not known.

    reason : in words, what is missing
    """

    rotation: np.ndarray | None
    position: np.ndarray | None
    reason: str


def camera_poses(track: VehicleTrack, stamp_ns: np.ndarray, mount_pitch_deg: float | None = None) -> CameraPoses:
    """Camera pose at the stamps (F,) of pictures: attitude on SO(3), position linearly between neighbouring states.

    The attitude is the gimbal's.  Without one, a camera fixed to the body counts if its pitch is told
    (``mount_pitch_deg``, negative looks down); nothing is assumed.  A picture farther than ``MAX_GAP_S`` from the
    states around it leaves all unknown: a pose is not invented.
    """
    attitude = track.gimbal
    missing = "the states of the vehicle tell no gimbal"
    if not np.isfinite(attitude).all(axis=1).any() and mount_pitch_deg is not None:
        half = -0.5 * np.deg2rad(mount_pitch_deg)  # FLU: positive about y (left) turns the nose down
        attitude = quaternion_multiply(track.orientation, np.array([0.0, np.sin(half), 0.0, np.cos(half)]))
        missing = "the states of the vehicle tell no attitude"
    rotation, rotation_gap = _interpolated(track.stamp_ns, attitude, stamp_ns, spherical=True)
    position, position_gap = _interpolated(track.stamp_ns, track.position, stamp_ns, spherical=False)
    reasons = []
    if rotation is None:
        reasons.append(missing if rotation_gap is None else f"pictures lie up to {rotation_gap:.1f} s from an attitude")
    if position is None:
        told = "the states of the vehicle tell no position"
        reasons.append(told if position_gap is None else f"pictures lie up to {position_gap:.1f} s from a position")
    return CameraPoses(None if rotation is None else camera_rotation(rotation), position, "; ".join(reasons))


def _interpolated(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, spherical: bool
) -> tuple[np.ndarray | None, float | None]:
    """Values (F, C) at the stamps, or None with the longest gap in s (None: there are no values at all)."""
    good = np.isfinite(values).all(axis=1)
    if not good.any() or not len(stamp_ns):
        return None, None
    known_ns, values = known_ns[good], values[good]
    after = np.clip(np.searchsorted(known_ns, stamp_ns), 1, max(len(known_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(known_ns) - 1)
    # Beyond the ends the nearest state holds; between two, their distance counts.
    inside = np.clip(stamp_ns, known_ns[0], known_ns[-1])
    span = known_ns[after] - known_ns[before]
    between = (inside == stamp_ns) & (stamp_ns != known_ns[before]) & (stamp_ns != known_ns[after])
    gap_s = np.maximum(np.where(between, span, 0), np.abs(inside - stamp_ns)).max() * _NS
    if gap_s > MAX_GAP_S:
        return None, float(gap_s)
    part = np.where(span > 0, (inside - known_ns[before]) / np.maximum(span, 1), 0.0)
    if spherical:
        return slerp(values[before], values[after], part), None
    return values[before] + part[:, None] * (values[after] - values[before]), None
