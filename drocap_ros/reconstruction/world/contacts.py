"""Probability that ankles and toes are in contact with the ground: from their speed, height and looks."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.world.world_model import ANKLES, FEET, FEET_HEIGHT_M, FLOOR, WorldState

_AVERAGE_FRAMES = 3
#: Time for which a foot that is not seen keeps its contact.
_HIDDEN_S = 0.25
_HEIGHT_STD_M = 0.1
#: Spread of the heights of resting feet on level ground, as the body's errors leave it, and on steps.
_LEVEL_M, _STEPS_M = 0.025, 0.06
#: Likelihood of a foot that moves, against that of one that rests at the floor: while scale and camera are found, which
#: false contacts bend, and when feet are locked in their places.
MOVING, MOVING_LOCKED = 0.5, 0.12
#: Least and largest probability of the network: neither a foot in contact nor a moving one depends on it alone.
_SURE = np.array([0.01, 0.99])
#: Probability of the network from which both feet count as resting, and least standard deviation (m/s) of the speed at
#: which two resting feet seem to part: 0.07 in the median of demo sessions, 0.3 where one of them moves.
_BOTH, _PARTING_M_S = 0.8, 0.07
#: The same where keypoints are noisier, over the median speed: most pairs that look at rest do rest.
_OF_MEDIAN = 0.7


def contact_probability(
    state: WorldState,
    fps: float,
    speed_std_m_s: float,
    seen: np.ndarray,
    still: np.ndarray | None = None,
    parting: np.ndarray | None = None,
    moving: float = MOVING,
) -> np.ndarray:
    """(F - 1, 4) for each step between two frames of each of ``FEET``.

    seen : (F, P) bool, of the joints; a toe or an ankle that no network sees is the lifter's guess and holds no foot
    speed_std_m_s : of a foot in contact, as far as the present joints are accurate
    still : (F, 2) the network's probability that the right and the left foot rest, None = unknown
    parting : (F - 1, 2) m/s, of :func:`parting_speed`; None = unknown
    moving : likelihood of a foot that moves, against that of one that rests
    """
    feet = state.joints[:, FEET]
    speed = _smooth(np.linalg.norm(np.diff(feet, axis=0), axis=-1) * fps)
    height = 0.5 * (feet[1:, :, 2] + feet[:-1, :, 2]) - state.globals[FLOOR] - FEET_HEIGHT_M
    resting = np.exp(-0.5 * np.square(speed / speed_std_m_s) - 0.5 * np.square(height / _HEIGHT_STD_M))
    likely = np.ones((len(resting), 2))
    if still is not None:
        looks = np.clip(0.5 * (still[1:] + still[:-1]), *_SURE)
        resting *= np.tile(looks / (1.0 - looks), 2)
        if parting is not None:
            likely = _resting_together(looks, parting)
    # Right and left of a pair: both rest, one does, or none.
    right, left = resting[:, ::2], resting[:, 1::2]
    both = right * left * likely
    total = both + moving * (right + left + moving)
    probability = np.empty_like(resting)
    probability[:, ::2], probability[:, 1::2] = (both + moving * right) / total, (both + moving * left) / total
    known = seen[:, FEET].copy()
    known[:, : len(ANKLES)] = ankles_seen(seen, fps)
    return probability * (known[1:] & known[:-1])


def ankles_seen(seen: np.ndarray, fps: float) -> np.ndarray:
    """(F, 2) whether a network saw the ankle, of joints (F, P), at the frame or shortly before or after it."""
    from scipy.ndimage import maximum_filter1d

    known: np.ndarray = maximum_filter1d(seen[:, ANKLES], 2 * round(_HIDDEN_S * fps) + 1, axis=0, mode="nearest")
    return known


def _resting_together(looks: np.ndarray, parting: np.ndarray) -> np.ndarray:
    """(F - 1, 2) likelihood that resting ankles, and toes, part so fast; 1 where not both feet look at rest."""
    at_rest = looks.min(axis=1) > _BOTH
    if not at_rest.any():
        return np.ones(parting.shape)
    std = np.maximum(_PARTING_M_S, _OF_MEDIAN * np.median(parting[at_rest], axis=0))
    return np.where(at_rest[:, None], np.exp(-0.5 * np.square(parting / std)), 1.0)


def parting_speed(joints: np.ndarray, fps: float) -> np.ndarray:
    """(F - 1, 2) m/s of joints (F, 17, 3): change of the vector between the ankles, and between the toes.

    Errors of the camera's place do not enter: it shows a small step that the network takes for rest, before the
    adjustment has bent the body so that both feet rest.
    """
    feet = joints[:, FEET]
    change = _smooth(np.diff(feet[:, ::2] - feet[:, 1::2], axis=0) * fps)
    speed: np.ndarray = np.linalg.norm(change, axis=-1)
    return speed


def _smooth(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import uniform_filter1d

    return uniform_filter1d(values, min(_AVERAGE_FRAMES, max(len(values), 1)), axis=0, mode="nearest")


def ground_spread(state: WorldState, contact: np.ndarray) -> float:
    """Standard deviation (m) of the heights of feet in contact (F - 1, 4) above the floor; NaN = no contact."""
    feet = state.joints[:, FEET, 2]
    height = 0.5 * (feet[1:] + feet[:-1]) - state.globals[FLOOR] - FEET_HEIGHT_M
    total = float(contact.sum())
    return float(np.sqrt((contact * np.square(height)).sum() / total)) if total > 1.0 else float("nan")


def floor_std(spread: float, loose: float) -> float:
    """Standard deviation (m) of the floor's term: tight on level ground, ``loose`` and more on steps or a slope."""
    if not np.isfinite(spread):
        return loose
    return max(_LEVEL_M, loose * (spread / _STEPS_M) ** 2)
