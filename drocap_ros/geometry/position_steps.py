"""Positions that are reported in steps: rounded coordinates, and reports that are held until the next one."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.interpolation import smoothed

#: Smoothing of the path through the steps.
_SMOOTHING_S = 0.25
#: A coordinate that changes by less from frame to frame rests: less than any log's rounding.
_REST_M = 1e-5
#: Steps in the median: rounded coordinates of 1e-7 deg have 11 mm.
_STEP_M = 0.005
#: Least share of the steps that stand alone between frames at rest; a flown path has hardly any.
_ALONE = 0.2
#: Fewer steps are no pattern.
_LEAST_STEPS = 4
#: Two steps that differ by more are a jump of the log, which stays as it is.
_JUMP_M = 1.0
#: Share of the times between reports that are alike where positions are held until the next report.
_ALIKE = 0.8


def without_steps(position: np.ndarray, stamp_ns: np.ndarray) -> np.ndarray:
    """Positions (F, 3) m at increasing stamps without the steps of rounded coordinates, or of held reports.

    A step of a rounded coordinate passes the middle of its two values; the path leads through these middles.  A held
    report was true when it came, so the middles are late by half the time between two.  Coordinates without steps stay
    as they are, bit for bit, and so do those with a jump.
    """
    change = np.diff(position, axis=0)
    moves = np.abs(change) > _REST_M
    out = position.copy()
    time = (stamp_ns - stamp_ns[0]) * 1e-9
    for axis in range(position.shape[1]):
        at, step = np.flatnonzero(moves[:, axis]), change[moves[:, axis], axis]
        if len(at) < _LEAST_STEPS or np.median(np.abs(step)) < _STEP_M or np.abs(np.diff(step)).max() > _JUMP_M:
            continue
        rests = np.pad(~moves[:, axis], 1)
        if (rests[at] | rests[at + 2]).mean() < _ALONE:
            continue
        late_s = _late_s(moves, time)
        passed = 0.5 * (time[at] + time[at + 1]) - late_s
        path = _through(time, passed, position[at, axis] + 0.5 * step, 1.0 if late_s else 0.5)
        smoothing = min(_SMOOTHING_S / float(np.median(np.diff(time))), len(time))
        out[:, axis] = smoothed(path[:, None], smoothing)[:, 0]
    return out


def _late_s(moves: np.ndarray, time: np.ndarray) -> float:
    """Half the time between two reports, of positions that move (F - 1, 3) at once and evenly; 0 = not held."""
    at = np.flatnonzero(moves.any(axis=1))
    gaps = np.diff(at)
    usual = float(np.median(gaps))
    held = usual >= 2 and (np.abs(gaps - usual) <= 1).mean() > _ALIKE
    return 0.5 * float(np.median(np.diff(time[at]))) if held else 0.0


def _through(time: np.ndarray, passed: np.ndarray, middles: np.ndarray, steps: float) -> np.ndarray:
    """(F,) line through ``middles`` (N,) at the times ``passed``, continued at both ends by so many steps at most."""
    path: np.ndarray = np.interp(time, passed, middles)
    for outside, i, j in ((time < passed[0], 0, 1), (time > passed[-1], -1, -2)):
        reach = steps * abs(middles[j] - middles[i])
        slope = (middles[j] - middles[i]) / (passed[j] - passed[i])
        path[outside] += np.clip((time[outside] - passed[i]) * slope, -reach, reach)
    return path
