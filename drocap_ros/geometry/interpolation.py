"""Poses and other values interpolated in time; positions in steps: rounded coordinates, reports held until the next."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp

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
    gap_s = np.where(between, span, 0) * 1e-9
    outside_s = np.abs(inside - stamp_ns) * 1e-9
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


def peak(values: np.ndarray, best: int) -> float:
    """Place of the top of the parabola through three values (N,), in samples from the middle one."""
    if not 0 < best < len(values) - 1:
        return 0.0
    before, here, after = values[best - 1 : best + 2]
    bend = before - 2.0 * here + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0


def without_steps(position: np.ndarray, stamp_ns: np.ndarray) -> np.ndarray:
    """Positions (F, 3) m at increasing stamps without the steps of rounded coordinates, or of held reports.

    A step of a rounded coordinate passes the middle of its two values; the path leads through these middles.  A held
    report was true when it came, so the middles are late by half the time between two.  Coordinates without steps stay
    as they are, bit for bit, and so do those with a jump.
    """
    change = np.diff(position, axis=0)
    # A coordinate that changes by less from frame to frame rests: less than any log's rounding.
    moves = np.abs(change) > 1e-5
    out = position.copy()
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    for axis in range(position.shape[1]):
        at, step = np.flatnonzero(moves[:, axis]), change[moves[:, axis], axis]
        # Fewer steps are no pattern.  Rounded coordinates of 1e-7 deg have 11 mm; two steps that differ by more than
        # 1 m are a jump of the log.
        if len(at) < 4 or np.median(np.abs(step)) < 0.005 or np.abs(np.diff(step)).max() > 1.0:
            continue
        rests = np.pad(~moves[:, axis], 1)
        # Least share of the steps that stand alone between frames at rest; a flown path has hardly any.
        if (rests[at] | rests[at + 2]).mean() < 0.2:
            continue
        late_s = _late_s(moves, time)
        passed = 0.5 * (time[at] + time[at + 1]) - late_s
        path = _through(time, passed, position[at, axis] + 0.5 * step, 1.0 if late_s else 0.5)
        # The path through the steps is smoothed over 0.25 s.
        smoothing = min(0.25 / float(np.median(np.diff(time))), len(time))
        out[:, axis] = smoothed(path[:, None], smoothing)[:, 0]
    return out


def _late_s(moves: np.ndarray, time: np.ndarray) -> float:
    """Half the time between two reports, of positions that move (F - 1, 3) at once and evenly; 0 = not held."""
    at = np.flatnonzero(moves.any(axis=1))
    gaps = np.diff(at)
    usual = float(np.median(gaps))
    # Held positions have reports at times that are alike.
    held = usual >= 2 and (np.abs(gaps - usual) <= 1).mean() > 0.8
    return 0.5 * float(np.median(np.diff(time[at]))) if held else 0.0


def _through(time: np.ndarray, passed: np.ndarray, middles: np.ndarray, steps: float) -> np.ndarray:
    """(F,) line through ``middles`` (N,) at the times ``passed``, continued at both ends by so many steps at most."""
    path: np.ndarray = np.interp(time, passed, middles)
    for outside, i, j in ((time < passed[0], 0, 1), (time > passed[-1], -1, -2)):
        reach = steps * abs(middles[j] - middles[i])
        slope = (middles[j] - middles[i]) / (passed[j] - passed[i])
        path[outside] += np.clip((time[outside] - passed[i]) * slope, -reach, reach)
    return path
