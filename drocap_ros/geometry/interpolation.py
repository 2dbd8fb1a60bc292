"""Poses and other values interpolated in time."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp

_NS = 1e-9  # s
#: Longest time between two states over which values are interpolated.
MAX_GAP_S = 2.0
#: Time beyond the first and last state for which these still hold; at 25 deg/s it is 2.5 deg.
HOLD_S = 0.1
#: Frames by which values are continued at both ends before smoothing; the smoothing's tail is cut there.
_CONTINUED = 12


def usual_step(times: np.ndarray) -> float:
    """Mean of the usual steps between times (F,), F >= 2, in their unit; pauses and lost frames do not count.

    Not the median: stamps in whole milliseconds of a camera with 120 Hz have steps of 8 and 9 ms.
    """
    steps = np.sort(np.diff(times))
    return float(steps[np.abs(steps / steps[len(steps) // 2] - 1.0) <= 0.5].mean())


def fill_frames(stamp_ns: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Poses (F, P, 3) whose frames of NaN are interpolated in time from their neighbours."""
    known = np.isfinite(joints).all(axis=(1, 2))
    if known.all():
        return joints
    if not known.any():
        raise InputError("initial_joints: expected a pose in at least one frame, got NaN in all; check the 2D joints")
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)
    count = int(np.count_nonzero(known))
    before = np.clip(np.searchsorted(t[known], t, side="right") - 1, 0, count - 1)
    after = np.minimum(before + 1, count - 1)
    t0, t1 = t[known][before], t[known][after]
    s = np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0)
    # Body and orientation separately: joints moved along straight lines would shrink a turning body.
    shape, rotation = to_torso_frame(joints[known])
    q = quaternion_from_matrix(rotation)
    turned = matrix_from_quaternion(slerp(q[before], q[after], s))
    bent = (1.0 - s)[:, None, None] * shape[before] + s[:, None, None] * shape[after]
    return np.where(known[:, None, None], joints, bent @ np.swapaxes(turned, 1, 2))


def true_runs(flags: np.ndarray) -> np.ndarray:
    """(R, 2) first index and the one after the last of each run of true flags (N,)."""
    edges: np.ndarray = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def interpolate(
    known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool, max_gap_s: float = MAX_GAP_S
) -> tuple[np.ndarray, np.ndarray]:
    """Values (F, C) at the stamps (F,), NaN where unknown, and the time (F,) s to or between the states used.

    A stamp between two states more than ``max_gap_s`` apart, or more than ``HOLD_S`` outside all states, has no value.
    Known values (N, C) with NaN are ignored; ``spherical`` interpolates quaternions.
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
    gap_s = np.where(between, span, 0) * _NS
    outside_s = np.abs(inside - stamp_ns) * _NS
    part = np.where(span > 0, (inside - known_ns[before]) / np.maximum(span, 1), 0.0)
    if spherical:
        found = slerp(values[before], values[after], part)
    else:
        found = values[before] + part[:, None] * (values[after] - values[before])
    unknown = (gap_s > max_gap_s) | (outside_s > HOLD_S)
    return np.where(unknown[:, None], np.nan, found), np.maximum(gap_s, outside_s)


def smoothed(values: np.ndarray, sigma: float) -> np.ndarray:
    """Values (F, C) through a Gaussian of ``sigma`` frames that keeps their slope at both ends.

    The values are continued there in straight lines.
    """
    from scipy.ndimage import gaussian_filter1d

    reach = min(_CONTINUED, len(values) - 1)
    steps = np.arange(1, _CONTINUED + 1)[:, None]
    before = values[0] - (values[reach] - values[0]) / max(reach, 1) * steps[::-1]
    after = values[-1] + (values[-1] - values[-1 - reach]) / max(reach, 1) * steps
    extended = np.concatenate([before, values, after])
    out: np.ndarray = gaussian_filter1d(extended, sigma, axis=0, mode="nearest")[_CONTINUED:-_CONTINUED]
    return out
