"""Toes of the simulated person: rigid feet that stand flat, roll over the toes and hang from a lifted leg."""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15

#: From the ankle to the tip of the big toe, share of the stature.
FOOT_LENGTH = 0.115
#: Height of a standing toe's tip above the ground.
TOE_HEIGHT_M = 0.02
#: Turn of a standing foot to its own side, rad.
_TOE_OUT = 0.12
#: Height of the ankle above its place in stance, in lengths of the foot, from which and up to which the foot goes over
#: from the ground's direction to that of the shank.
_LEAVES = 0.6
_FREE = 1.3  # lengths of the foot; a judgement, as the lower bound


def add_toes(joints: np.ndarray, heading: np.ndarray, stature_m: float) -> np.ndarray:
    """Joints (F, 17, 3) m of ``BODY_17`` from those of ``BODY_15``.

    The bone from ankle to toe has one length.  Near the ground the toe keeps its height, however high the ankle is;
    the foot of a lifted leg is perpendicular to the shank.

    Parameters
    ----------
    joints : (F, 15, 3) m, z up, the ground at z = 0
    heading : (F, 2) rad, of the right and the left foot, about the vertical
    """
    length = FOOT_LENGTH * stature_m
    toes = []
    for side, letter in enumerate("rl"):
        ankle, knee = (joints[:, BODY_15.index(letter + name)] for name in ("ankle", "knee"))
        yaw = heading[:, side] + (_TOE_OUT if letter == "l" else -_TOE_OUT)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
        drop = np.clip((ankle[:, 2] - TOE_HEIGHT_M) / length, 0.0, 0.95)
        ground = np.sqrt(1 - drop**2)[:, None] * ahead - drop[:, None] * (0.0, 0.0, 1.0)
        shank = _unit(ankle - knee)
        free = _unit(ahead - np.sum(ahead * shank, axis=1, keepdims=True) * shank)
        lifted = np.clip((ankle[:, 2] / length - _LEAVES) / (_FREE - _LEAVES), 0.0, 1.0)
        share = (lifted**2 * (3 - 2 * lifted))[:, None]
        way = _unit((1 - share) * ground + share * free)
        # No toe enters the ground.
        lowest = (TOE_HEIGHT_M - ankle[:, 2]) / length
        low = way[:, 2] < lowest
        flat = _unit(way * (1, 1, 0)) * np.sqrt(np.maximum(1 - np.minimum(lowest, 0.0) ** 2, 0.0))[:, None]
        way[low] = (flat + np.minimum(lowest, 0.0)[:, None] * (0.0, 0.0, 1.0))[low]
        toes.append(ankle + length * way)
    return np.concatenate([joints, np.stack(toes, axis=1)], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9))
