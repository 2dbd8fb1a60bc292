"""Lengths of bones, and the proportions that turn them into stature."""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, BODY_17, RIGID_BONES, indices

#: Sum of the ten rigid limb lengths over stature: 1.876 over the head joint's standing height on the native CMU
#: skeletons of the training set; that joint lies about 9 cm below the top of the head.
LIMBS_PER_STATURE = 1.78
_RIGID_ENDS = np.array([indices(BODY_15.joints, bone) for bone in RIGID_BONES])


def pair_lengths(joints: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Distances (..., L) over pairs (L, 2) of the joints (..., P, D)."""
    return np.asarray(np.linalg.norm(joints[..., pairs[:, 1], :] - joints[..., pairs[:, 0], :], axis=-1))


def bone_lengths(joints: np.ndarray) -> np.ndarray:
    """Length (..., P - 1) of every bone of poses (..., P, D) of BODY_15 or BODY_17: that of joint j stands at j - 1."""
    return pair_lengths(joints, BODY_17.bones[: joints.shape[-2] - 1])


def limb_lengths(poses: np.ndarray) -> np.ndarray:
    """Length (..., 10) of each of :data:`~drocap_ros.skeleton.RIGID_BONES` of poses (..., P, 3), BODY_15 first."""
    return pair_lengths(poses, _RIGID_ENDS)
