"""Probability that ankles and toes are in contact with the ground, from their speed and height above the floor."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.world.world_model import ANKLES, FEET, FEET_HEIGHT_M, FLOOR, WorldState

_AVERAGE_FRAMES = 5
_HEIGHT_STD_M = 0.1
#: Likelihood of a foot that moves, against that of one that rests at the floor.
_MOVING = 0.15


def contact_probability(state: WorldState, fps: float, speed_std_m_s: float, seen: np.ndarray) -> np.ndarray:
    """(F - 1, 4) for each step between two frames of each of ``FEET``.

    seen : (F, P) bool, of the joints; a toe that no network sees is the lifter's guess and holds no foot
    speed_std_m_s : of a foot in contact, as far as the present joints are accurate
    """
    from scipy.ndimage import uniform_filter1d

    feet = state.joints[:, FEET]
    speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * fps
    speed = uniform_filter1d(speed, min(_AVERAGE_FRAMES, max(len(speed), 1)), axis=0, mode="nearest")
    height = 0.5 * (feet[1:, :, 2] + feet[:-1, :, 2]) - state.globals[FLOOR] - FEET_HEIGHT_M
    resting = np.exp(-0.5 * np.square(speed / speed_std_m_s) - 0.5 * np.square(height / _HEIGHT_STD_M))
    probability: np.ndarray = resting / (resting + _MOVING)
    toes = FEET[len(ANKLES) :]
    probability[:, len(ANKLES) :] *= seen[1:, toes] & seen[:-1, toes]
    return probability
