"""The offset of two recordings of one motion, by how the distances between its joints change: no camera, no world."""

from __future__ import annotations

import itertools

import numpy as np

from drocap_ros.skeleton import BODY_15, LIMB_JOINTS, indices

#: Steps of the search, s, the coarse one over all offsets, and the range of the fine one.
_COARSE_S, _FINE_S, _ABOUT_S = 0.05, 0.01, 0.1
#: Least common part, share of the shorter recording.
_LEAST_PART = 0.5
#: Farthest two offsets of one fit, s, and largest share of the difference of all others that the best may have.
_SAME_S, _CLEAR = 0.5, 0.9
_PAIRS = np.array(list(itertools.combinations(indices(BODY_15.joints, LIMB_JOINTS).tolist(), 2)))


def find_offset(
    estimate: np.ndarray, estimate_s: np.ndarray, truth: np.ndarray, truth_s: np.ndarray
) -> tuple[float, float] | None:
    """Seconds to add to the estimate's times, and the mean difference there as a share of that of other offsets.

    None where no offset is clearly better than all others.

    estimate, truth : (F, P, 3) and (T, P, 3), BODY_15 first, NaN unknown; times (F,) and (T,) s increase
    """
    grid = np.arange(0.0, estimate_s[-1] - estimate_s[0], _COARSE_S) + estimate_s[0]
    other = np.arange(0.0, truth_s[-1] - truth_s[0], _COARSE_S) + truth_s[0]
    a, b = _sampled(estimate, estimate_s, grid), _sampled(truth, truth_s, other)
    least = max(int(_LEAST_PART * min(len(a), len(b))), 2)
    shifts = np.arange(least - len(a), len(b) - least + 1)
    if len(a) < least or len(b) < least or len(shifts) < 2:
        return None
    off = np.array([_difference(a, b, shift) for shift in shifts.tolist()])
    best = int(np.argmin(off))
    others = off[np.abs(shifts - shifts[best]) * _COARSE_S > _SAME_S]
    if not len(others) or off[best] > _CLEAR * np.min(others):
        return None
    seconds = float(other[0] - grid[0] + shifts[best] * _COARSE_S)
    fine = seconds + np.arange(-_ABOUT_S, _ABOUT_S + 0.5 * _FINE_S, _FINE_S)
    fits = []
    for shift in fine:
        inside = (grid + shift >= truth_s[0]) & (grid + shift <= truth_s[-1])
        fits.append(float(np.abs(a[inside] - _sampled(truth, truth_s, grid[inside] + shift)).mean()))
    return float(fine[int(np.argmin(fits))]), float(off[best] / np.median(others))


def _sampled(joints: np.ndarray, time_s: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(N, 66) distances between the limb joints at times (N,), as shares of their mean; gaps are bridged."""
    distances = np.linalg.norm(joints[:, _PAIRS[:, 0]] - joints[:, _PAIRS[:, 1]], axis=-1)
    known = np.isfinite(distances).all(axis=1)
    distances, time_s = distances[known], time_s[known]
    if not len(distances):
        return np.zeros((0, len(_PAIRS)))
    at = np.stack([np.interp(wanted, time_s, column) for column in distances.T], axis=1)
    at = 0.25 * (np.roll(at, 1, axis=0) + 2 * at + np.roll(at, -1, axis=0))  # less noise; the ends weigh little
    return np.asarray(at / distances.mean())


def _difference(a: np.ndarray, b: np.ndarray, shift: int) -> float:
    """Mean difference of ``a`` from ``b``, whose row ``shift`` lies beside the first of ``a``."""
    begin, end = max(0, -shift), min(len(a), len(b) - shift)
    return float(np.abs(a[begin:end] - b[begin + shift : end + shift]).mean())
