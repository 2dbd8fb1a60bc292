"""Pairs of keyframes from which a camera's path may begin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.reconstruction.camera.sightings import Sightings, rays, turn_between

#: Times (s) between the keyframes of a pair, and how many places of a recording are tried.
_PAIR_S = (0.5, 1.0, 2.0, 3.0)
_PLACES = 12
#: Points that both keyframes of a pair see, at least, and pairs that are tried.
_LEAST_COMMON = 16
_PAIRS = 3
#: Parallax (rad) above which more helps no pair, and from which a camera does not move little: six degrees.
ENOUGH_PARALLAX = 0.1
#: Percentile of the points' parallaxes that counts.
_NEARER = 75


class Pair(NamedTuple):
    """Two keyframes, the parallax (rad) of the nearer points, and their worth as a beginning."""

    first: int
    second: int
    parallax: float
    score: float


def candidate_pairs(sightings: Sightings, matrix: np.ndarray, key_hz: float) -> list[Pair]:
    """Pairs with much parallax and many common points, best first."""
    found: list[Pair] = []
    for lag_s in _PAIR_S:
        lag = max(round(lag_s * key_hz), 1)
        if lag >= len(sightings):
            continue
        for first in np.unique(np.linspace(0, len(sightings) - 1 - lag, _PLACES).astype(int)).tolist():
            both = sightings.common(first, first + lag)
            if len(both.piece) < _LEAST_COMMON:
                continue
            _, angle = turn_between(rays(both.first, matrix), rays(both.second, matrix))
            # Far points have no parallax: that of the nearer points counts.
            parallax = float(np.percentile(angle, _NEARER))
            score = min(parallax, ENOUGH_PARALLAX) * float(np.sqrt(len(both.piece)))
            found.append(Pair(first, first + lag, parallax, score))
    found.sort(key=lambda pair: -pair.score)
    apart: list[Pair] = []
    for pair in found:
        if all(abs(pair.first - other.first) > key_hz for other in apart):
            apart.append(pair)
    return apart[:_PAIRS]
