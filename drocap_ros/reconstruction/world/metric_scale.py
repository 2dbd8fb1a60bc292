"""Metric scale from the camera's own motion: a foot on the ground is still while the drone moves.

A monocular reconstruction lacks a factor.  The camera's position is metric; the factor that keeps the feet still
longest is the scale.  Only motion across the line of sight counts: pixels measure it well, unlike that along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.contacts import rest_likelihood
from drocap_ros.reconstruction.world.findings import MEASURED

#: Times (s) between two positions of a foot: parts of the half second for which a walker's foot stands.
LAGS_S = (0.15, 0.25, 0.4)

#: Standard deviation (m) of the way of a foot at rest across the line of sight: errors of adjusted poses.
STILL_M = 0.03

#: Least factor: a person of 1.02 m at the usual assumed stature of 1.70 m;
LOWEST = 0.6
#: and the greatest one, beyond all people.
HIGHEST = 1.6

#: Most pairs of frames, spread over the recording: more take time and tell the same.
MOST_PAIRS = 4000


@dataclass(frozen=True)
class ScaleEstimate:
    """Factor on the assumed scale, its relative standard deviation, and the share of still feet."""

    factor: float
    std: float
    support: float

    @property
    def trusted(self) -> bool:
        """Whether camera and feet determine the scale: to 3 %, by a fifth of the pairs, within the range."""
        return self.std < MEASURED and self.support > 0.2 and LOWEST * 1.02 < self.factor < HIGHEST / 1.02


def estimate_scale(feet: np.ndarray, camera_position: np.ndarray, stamp_ns: np.ndarray) -> ScaleEstimate | None:
    """Scale at which the feet are still.

    Parameters
    ----------
    feet : (F, N, 3) m at the assumed scale, camera to foot, world axes
    camera_position : (F, 3) m, world axes
    stamp_ns : (F,)

    Returns
    -------
    ScaleEstimate, or None when the camera moves too little or there are too few frames
    """
    gap, base = _pairs(feet, camera_position, stamp_ns)
    # Camera motion below a foot's uncertainty carries no information.
    moved = np.linalg.norm(base, axis=1) > 5.0 * STILL_M
    gap, base = gap[moved], base[moved]
    if len(gap) < 50:
        return None
    # |base + factor * gap|^2 for all factors at once.
    a, b, c = (np.sum(x * y, axis=1) for x, y in ((gap, gap), (gap, base), (base, base)))
    factors = np.geomspace(LOWEST, HIGHEST, 200)
    square = np.maximum(a[:, None] * factors**2 + 2.0 * b[:, None] * factors + c[:, None], 0.0)
    score = rest_likelihood(square, STILL_M).sum(0)
    factor = float(factors[np.argmax(score)])
    for _ in range(10):
        weight = rest_likelihood(np.maximum(a * factor**2 + 2.0 * b * factor + c, 0.0), STILL_M)
        if weight.sum() < 1e-9:
            return None
        factor = float(np.clip(-np.sum(weight * b) / np.sum(weight * a), LOWEST, HIGHEST))
    support = float(weight.mean())
    # Neighbouring pairs share their frames: a tenth of them is independent.
    independent = max(support * len(gap) / 10.0, 1.0)
    spread = np.sqrt(np.sum(weight * (a * factor**2 + 2.0 * b * factor + c)) / weight.sum() / 2.0)
    lever = np.sqrt(np.sum(weight * a) / weight.sum())
    return ScaleEstimate(factor, float(spread / (lever * factor * np.sqrt(independent))), support)


def _pairs(feet: np.ndarray, camera: np.ndarray, stamp_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Changes (M, 3) of camera-to-foot vectors and of the camera over the lags, across the line of sight."""
    gaps: list[np.ndarray] = []
    bases: list[np.ndarray] = []
    for lag_s in LAGS_S:
        later = np.searchsorted(stamp_ns, stamp_ns + round(lag_s * 1e9))
        first = np.flatnonzero(later < len(stamp_ns))
        # Pairs across a gap of the recording are left out.
        first = first[(stamp_ns[later[first]] - stamp_ns[first]) < 1.5e9 * lag_s]
        stride = max(1, len(first) * feet.shape[1] * len(LAGS_S) // MOST_PAIRS)
        first = first[::stride]
        second = later[first]
        sight = feet[first] + feet[second]
        sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
        for out, change in (
            (gaps, feet[second] - feet[first]),
            (bases, np.broadcast_to((camera[second] - camera[first])[:, None], feet[first].shape)),
        ):
            out.append((change - np.sum(change * sight, axis=-1, keepdims=True) * sight).reshape(-1, 3))
    return np.concatenate(gaps), np.concatenate(bases)
