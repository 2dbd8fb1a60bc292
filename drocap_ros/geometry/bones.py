"""Lengths of bones, and the proportions that turn them into stature."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from drocap_ros.skeleton import BODY_15, BODY_17, RIGID_BONES, indices

#: Sum of the ten rigid limb lengths over stature: 1.876 over the head joint's standing height on the native CMU
#: skeletons of the training set; that joint lies about 9 cm below the top of the head.
LIMBS_PER_STATURE = 1.78


def pair_lengths(joints: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distances (..., L) over pairs (L, 2) of the joints (..., P, D)."""
    return np.linalg.norm(joints[..., pairs[:, 1], :] - joints[..., pairs[:, 0], :], axis=-1)


def bone_lengths(joints: np.ndarray) -> np.ndarray:
    """Length (..., P - 1) of every bone of poses (..., P, D) of BODY_15 or BODY_17: that of joint j stands at j - 1."""
    return pair_lengths(joints, BODY_17.bones[: joints.shape[-2] - 1])


def limb_lengths(poses: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> np.ndarray:
    """Length (..., 10) of each of :data:`~drocap_ros.skeleton.RIGID_BONES` of poses (..., P, 3)."""
    return pair_lengths(poses, _rigid_ends(joints))


@lru_cache(maxsize=8)
def _rigid_ends(joints: tuple[str, ...]) -> np.ndarray:
    return np.array([indices(joints, bone) for bone in RIGID_BONES])
