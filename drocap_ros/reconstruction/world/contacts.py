"""Probability that ankles and toes are in contact with the ground: from their speed, height and looks."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.world.world_model import ANKLES, FEET, FEET_HEIGHT_M, FLOOR, WorldState

_AVERAGE_FRAMES = 3
_HEIGHT_STD_M = 0.1
#: Spread of the heights of resting feet on level ground, as the body's errors leave it, and on steps.
_LEVEL_M, _STEPS_M = 0.025, 0.06
#: Likelihood of a foot that moves, against that of one that rests at the floor.
_MOVING = 0.25
#: Least and largest probability of the network: neither a foot in contact nor a moving one depends on it alone.
_SURE = np.array([0.01, 0.99])


def contact_probability(
    state: WorldState, fps: float, speed_std_m_s: float, seen: np.ndarray, still: np.ndarray | None = None
) -> np.ndarray:
    """(F - 1, 4) for each step between two frames of each of ``FEET``.

    seen : (F, P) bool, of the joints; a toe that no network sees is the lifter's guess and holds no foot
    speed_std_m_s : of a foot in contact, as far as the present joints are accurate
    still : (F, 2) the network's probability that the right and the left foot rest, None = unknown
    """
    from scipy.ndimage import uniform_filter1d

    feet = state.joints[:, FEET]
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * fps
    speed = uniform_filter1d(speed, min(_AVERAGE_FRAMES, max(len(speed), 1)), axis=0, mode="nearest")
    height = 0.5 * (feet[1:, :, 2] + feet[:-1, :, 2]) - state.globals[FLOOR] - FEET_HEIGHT_M
    resting = np.exp(-0.5 * np.square(speed / speed_std_m_s) - 0.5 * np.square(height / _HEIGHT_STD_M))
    if still is not None:
        looks = np.clip(0.5 * (still[1:] + still[:-1]), *_SURE)
        resting *= np.tile(looks / (1.0 - looks), 2)
    probability: np.ndarray = resting / (resting + _MOVING)
    toes = FEET[len(ANKLES) :]
    probability[:, len(ANKLES) :] *= seen[1:, toes] & seen[:-1, toes]
    return probability


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
