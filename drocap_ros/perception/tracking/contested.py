"""Joints of a whole recording that two persons have at one place: whose they are, the images before and after tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drocap_ros.skeleton import BODY_15

_SAME = 0.08  # distance of joints that may be one, lengths of the body
_NEAR_S = 0.7  # time to an image in which the joint is nobody else's, on either side
_OFF = 0.08  # distance from the way between these images at which it is still the own, lengths,
_OFF_PER_S = 0.15  # and more per second to the nearer one


def contested(people: Sequence[np.ndarray], stamp_ns: np.ndarray, length: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Joints (F, P) bool of each person that are more likely another's.

    people : (F, P, 2) px of each, ``BODY_15`` first; stamp_ns : (F,); length : (F,) px of each one's body
    """
    times, count = stamp_ns * 1e-9, len(BODY_15)
    found = []
    for k, xy in enumerate(people):
        near = np.zeros(xy.shape[:2], bool)
        for other in (o for i, o in enumerate(people) if i != k):
            for theirs in (other[:, :count], other[:, BODY_15.mirror]):
                apart = np.linalg.norm(xy[:, :count] - theirs, axis=2)
                near[:, :count] |= apart < _SAME * length[k][:, None]
        doubtful = np.zeros_like(near)
        for j in np.flatnonzero(near.any(axis=0)):
            seen = np.isfinite(xy[:, j]).all(axis=1)
            sure = np.flatnonzero(seen & ~near[:, j])
            for f in np.flatnonzero(near[:, j]):
                doubtful[f, j] = _is_off(xy[:, j], sure, times, int(f), float(length[k][f]))
        found.append(doubtful)
    return found


def _is_off(xy: np.ndarray, sure: np.ndarray, times: np.ndarray, f: int, length: float) -> bool:
    """Whether a place (F, 2) px in image ``f`` is off the way between the nearest of the sure images."""
    at = int(np.searchsorted(sure, f))
    if at == 0 or at == len(sure):
        return True
    before, after = int(sure[at - 1]), int(sure[at])
    since, until = times[f] - times[before], times[after] - times[f]
    if max(since, until) > _NEAR_S:
        return True
    way = xy[before] + since / (since + until) * (xy[after] - xy[before])
    return bool(np.linalg.norm(xy[f] - way) > length * (_OFF + _OFF_PER_S * min(since, until)))
