"""Time of one recording in another: by the motion of the one person that both show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.interpolation import peak, usual_step
from drocap_ros.skeleton import BODY_17, indices

#: Rate (Hz) at which motions are compared.
RATE_HZ = 100.0
#: Shortest time (s) in which two recordings show the person together.
LEAST_S = 1.5
#: Joints whose heights above the pelvis and whose distances from each other are compared.
_MOVING = ("head", "rwrist", "lwrist", "relbow", "lelbow", "rknee", "lknee", "rankle", "lankle")
#: Time (s) between two different answers: motions repeat themselves after a step at the earliest.
_APART_S = 0.3


class TimeOffset(NamedTuple):
    """``time of the first = time of the second + seconds``.

    likeness : correlation of both motions there, at most 1
    """

    seconds: float
    likeness: float


class ShownMotion(NamedTuple):
    """A motion of F images.

    joints : (F, 17, 3) m, z up; time_s : (F,) on a clock of its own; seen : (F,) whether an image shows the person
    """

    joints: np.ndarray
    time_s: np.ndarray
    seen: np.ndarray


def time_offsets(first: ShownMotion, second: ShownMotion, *, level: bool = True) -> list[TimeOffset]:
    """Offsets under which two motions are most alike, best first, at most four.

    level : z of both is up; else distances between joints are compared alone
    """
    a, b = _signals(first, level), _signals(second, level)
    score = _correlations(a, b)
    if score is None:
        return []
    lag = np.arange(len(score)) - (len(b) - 1)
    left = score.copy()
    found: list[TimeOffset] = []
    while len(found) < 4 and left.max() > 0.0:
        best = int(left.argmax())
        seconds = (lag[best] + peak(score, best)) / RATE_HZ + first.time_s[0] - second.time_s[0]
        left[max(best - round(_APART_S * RATE_HZ), 0) : best + round(_APART_S * RATE_HZ) + 1] = 0.0
        found.append(TimeOffset(float(seconds), float(score[best])))
    return found


def _signals(motion: ShownMotion, level: bool) -> np.ndarray:
    """(N, K) heights and distances of joints at ``RATE_HZ``, without what is slow: the same in every level view.

    They are 0 where no image shows the person.
    """
    from scipy.ndimage import gaussian_filter1d

    joints, time = motion.joints, motion.time_s
    at = indices(BODY_17.joints, _MOVING)
    one, other = np.triu_indices(len(at), 1)
    distance = np.linalg.norm(joints[:, at[one]] - joints[:, at[other]], axis=-1)
    # Weight of a distance against that of a height: depths of a single view err.
    values = np.concatenate([level * (joints[:, at, 2] - joints[:, :1, 2]), 0.3 * distance], axis=1)
    even = np.arange(time[0], time[-1], 1.0 / RATE_HZ)
    values = np.stack([np.interp(even, time, column) for column in values.T], axis=1)
    # Standard deviation (s) of the average that takes noise out.
    smooth = max(0.03, usual_step(time)) * RATE_HZ
    values = gaussian_filter1d(values, smooth, axis=0, mode="nearest")
    # Standard deviation (s) of the average that is taken out: what stays is motion, without posture and errors that
    # last.
    values -= gaussian_filter1d(values, RATE_HZ, axis=0, mode="nearest")
    shown = np.concatenate([[-np.inf], time[motion.seen], [np.inf]])
    after = np.searchsorted(shown, even)
    # Longest time (s) without the person that is bridged.
    values[shown[after] - shown[after - 1] > 0.3] = 0.0
    return np.asarray(values)


def _correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """(N + M - 1,) correlation of the signals for every lag of b in a; 0 where they overlap too little."""
    from scipy.signal import fftconvolve

    back = b[::-1]
    ones_a, ones_b = (signals.any(axis=1).astype(np.float64) for signals in (a, back))
    shorter = min(ones_a.sum(), ones_b.sum())
    if shorter < LEAST_S * RATE_HZ:
        return None
    together = fftconvolve(a, back, axes=0).sum(axis=1)
    energy_a = fftconvolve(np.square(a).sum(axis=1), ones_b)
    energy_b = fftconvolve(ones_a, np.square(back).sum(axis=1))
    overlap = np.maximum(fftconvolve(ones_a, ones_b), 0.0)
    usual = 0.1 * max(np.square(a).sum() / ones_a.sum(), np.square(b).sum() / ones_b.sum()) * overlap
    score = together / np.sqrt(np.maximum(energy_a, usual) * np.maximum(energy_b, usual) + 1e-12)
    # A long time together says more than a short one that is as alike.
    score *= np.minimum(1.0, overlap / shorter) ** 0.25
    return np.where(overlap >= LEAST_S * RATE_HZ - 0.5, score, 0.0)
