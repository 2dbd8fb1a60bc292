"""Alignment of point sets, the body-fixed torso frame, lengths of bones and what they say of the stature."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import project_to_so3
from drocap_ros.skeleton import BODY_15, BODY_17, RIGID_BONES, JointSet, indices

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


def similarity(
    source: np.ndarray, target: np.ndarray, *, with_scale: bool = True
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Best similarity transformation without reflection (Umeyama 1991), per leading index.

    source, target : (..., P, 3)
    with_scale : False for a rigid motion
    returns : scale (...), rotation (..., 3, 3), translation (..., 3), of
        ``target ~ scale * source @ rotation^T + translation``; a source of one point has scale 1
    """
    # An array, not a number: the products, and the order of the sums over them, then do not depend on the layout of
    # the points in memory.
    w = np.full((*source.shape[:-1], 1), 1.0 / source.shape[-2])
    mean_s, mean_t = np.sum(w * source, axis=-2, keepdims=True), np.sum(w * target, axis=-2, keepdims=True)
    s, t = source - mean_s, target - mean_t
    cross = np.swapaxes(t, -1, -2) @ (w * s)
    rotation = project_to_so3(cross)
    spread = np.sum(w * s * s, axis=(-2, -1))
    scale = np.ones(spread.shape)
    if with_scale:
        fitted = np.sum(rotation * cross, axis=(-2, -1))
        scale = np.where(spread > 1e-300, fitted / np.where(spread > 1e-300, spread, 1.0), 1.0)
    translation = mean_t - scale[..., None, None] * (mean_s @ np.swapaxes(rotation, -1, -2))
    return scale, rotation, translation[..., 0, :]


def apply_similarity(
    points: np.ndarray, scale: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> np.ndarray:
    """``scale * points @ rotation^T + translation`` for points (..., P, 3)."""
    return np.asarray(scale[..., None, None] * (points @ np.swapaxes(rotation, -1, -2)) + translation[..., None, :])


def torso_frame(s: np.ndarray, joints: JointSet = BODY_15) -> np.ndarray:
    """Body-fixed frame of each pose: x forward, y left, z up along the trunk.

    s : (..., P, 3), any right-handed frame and unit
    returns : (..., 3, 3) rotation; its columns are the axes of the body, so ``s @ torso_frame(s)`` is the pose in
        them; the trunk's axis is pelvis to neck, left is right-to-left over hips and shoulders
    """
    at = {name: s[..., joints.index(name), :] for name in ("neck", "pelvis", "lhip", "rhip", "lshoulder", "rshoulder")}
    z = unit_or(at["neck"] - at["pelvis"], np.array([0.0, 0.0, 1.0]))
    left = unit_or(at["lhip"] - at["rhip"], np.zeros(3)) + unit_or(at["lshoulder"] - at["rshoulder"], np.zeros(3))
    left = left - np.sum(left * z, axis=-1, keepdims=True) * z
    # Without a left-right direction any axis perpendicular to z serves.
    across = np.cross(z, np.where(np.abs(z[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])))
    y = unit_or(left, unit_or(across, np.zeros(3)))
    return np.stack([np.cross(y, z), y, z], axis=-1)


def unit_or(v: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; the fallback where they have none."""
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    good = norm > 1e-9
    return np.where(good, v / np.where(good, norm, 1.0), fallback)


def directions(v: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; 0 of those without length."""
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9))


def to_torso_frame(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split poses into body-fixed shapes and the rotation of the body.

    s : (..., P, 3) of BODY_15, for example in the camera's frame
    returns : shape (..., P, 3), rotation (..., 3, 3), of ``s == shape @ rotation^T``
    """
    rotation = torso_frame(s)
    return s @ rotation, rotation
