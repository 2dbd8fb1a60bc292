"""Error measures of a reconstruction against the truth; lengths keep the unit of the input.

Poses are (F, 15, 3) of BODY_15 or (F, 17, 3) of BODY_17 unless said otherwise.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, indices

#: The groups of the paper's table of errors per joint.
JOINT_GROUPS = {
    "wrist": ("lwrist", "rwrist"),
    "elbow": ("lelbow", "relbow"),
    "shoulder": ("lshoulder", "rshoulder"),
    "hip": ("lhip", "rhip"),
    "knee": ("lknee", "rknee"),
    "ankle": ("lankle", "rankle"),
}
#: Frames of W-MPJPE's segments.
SEGMENT = 100
_LIMBS = indices(BODY_15.joints, LIMB_JOINTS)
_TOES = indices(BODY_17.joints, ("rtoe", "ltoe"))
_MIRROR = np.array([1.0, 1.0, -1.0])


def aligned_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distance (..., P) of each joint (..., P, 3) after the best similarity transformation per pose, no reflection."""
    return np.linalg.norm(apply_similarity(estimate, *similarity(estimate, truth)) - truth, axis=-1)


def pa_mpjpe(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The paper's reconstruction error (F,): :func:`aligned_error` averaged over the twelve limb joints."""
    return aligned_error(estimate[..., _LIMBS, :], truth[..., _LIMBS, :]).mean(-1)


def w_mpjpe(estimate: np.ndarray, truth: np.ndarray, aligned: int = 2) -> np.ndarray:
    """W-MPJPE (F,) of poses (F, P, 3) in world frames, over all given joints.

    One rigid alignment per segment of 100 frames, on the segment's first ``aligned`` frames, without scale; on all of
    them it is WA-MPJPE.
    """
    out = np.empty(len(truth))
    for first in range(0, len(truth), SEGMENT):
        est, tru = estimate[first : first + SEGMENT], truth[first : first + SEGMENT]
        fit = similarity(est[:aligned].reshape(-1, 3), tru[:aligned].reshape(-1, 3), with_scale=False)
        moved = apply_similarity(est.reshape(-1, 3), *fit).reshape(est.shape)
        out[first : first + SEGMENT] = np.linalg.norm(moved - tru, axis=-1).mean(-1)
    return out


def scale_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Mean estimated over mean true limb length, less 1; limbs with a joint that is NaN are left out."""
    ours, true = limb_lengths(estimate), limb_lengths(truth)
    known = np.isfinite(ours).all(axis=0) & np.isfinite(true).all(axis=0)
    return float(ours[:, known].mean() / true[:, known].mean() - 1.0)


def mirrored_frames(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(F,) bool: the mirror image of the estimate is closer to the truth than the estimate.

    The reprojection error of a mirrored body can be zero, so the 3D poses have to be compared.
    """
    return pa_mpjpe(estimate * _MIRROR, truth) < pa_mpjpe(estimate, truth)


def is_mirrored(estimate: np.ndarray, truth: np.ndarray) -> bool:
    """Whether the mirror image of the whole sequence has the lower mean error."""
    return bool(pa_mpjpe(estimate * _MIRROR, truth).mean() < pa_mpjpe(estimate, truth).mean())


def horizon_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(F,) rad, tilt of the vertical in the rotation that aligns the estimate with the truth, both z-up."""
    _, rotation, _ = similarity(estimate[:, _LIMBS], truth[:, _LIMBS])
    return np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0))


def group_errors(estimate: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Mean error per group of :data:`JOINT_GROUPS`, after the alignment over the twelve limb joints."""
    errors = dict(zip(LIMB_JOINTS, aligned_error(estimate[:, _LIMBS], truth[:, _LIMBS]).mean(0), strict=True))
    return {group: float(np.mean([errors[joint] for joint in members])) for group, members in JOINT_GROUPS.items()}


def toe_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Mean error of the toes after the alignment over the twelve limb joints; NaN where either has no toes."""
    if min(estimate.shape[1], truth.shape[1]) < len(BODY_17):
        return float("nan")
    fit = similarity(estimate[:, _LIMBS], truth[:, _LIMBS])
    gap = np.linalg.norm(apply_similarity(estimate[:, _TOES], *fit) - truth[:, _TOES], axis=-1)
    known = np.isfinite(gap)
    return float(gap[known].mean()) if known.any() else float("nan")
