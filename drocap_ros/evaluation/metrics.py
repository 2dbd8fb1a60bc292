"""Error measures of a reconstruction; lengths keep the unit of the input."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.skeleton import BODY_15, LIMB_JOINTS, JointSet, indices

#: The groups of the paper's table of errors per joint.
JOINT_GROUPS = {
    "wrist": ("lwrist", "rwrist"),
    "elbow": ("lelbow", "relbow"),
    "shoulder": ("lshoulder", "rshoulder"),
    "hip": ("lhip", "rhip"),
    "knee": ("lknee", "rknee"),
    "ankle": ("lankle", "rankle"),
}


def limb_indices(joints: tuple[str, ...] = BODY_15.joints) -> np.ndarray:
    """(12,) int, places of the twelve joints of the paper's tables."""
    return indices(joints, LIMB_JOINTS)


def aligned_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distance (..., P) of each joint after the best similarity transformation per pose (no reflection).

    Parameters
    ----------
    estimate, truth : (..., P, 3)
    """
    return np.linalg.norm(apply_similarity(estimate, *similarity(estimate, truth)) - truth, axis=-1)


def pa_mpjpe(estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> np.ndarray:
    """The paper's reconstruction error per frame: :func:`aligned_error` averaged over the twelve limb joints.

    Parameters
    ----------
    estimate, truth : (F, P, 3)

    Returns
    -------
    (F,) in the unit of ``truth``
    """
    use = limb_indices(joints)
    return aligned_error(estimate[..., use, :], truth[..., use, :]).mean(-1)


def w_mpjpe(
    estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints, segment: int = 100
) -> np.ndarray:
    """Error per frame (F,) after one rigid alignment per segment of 100 frames, on its first two frames, no scale.

    Parameters
    ----------
    estimate, truth : (F, P, 3) in world frames
    """
    use = limb_indices(joints)
    out = np.empty(len(truth))
    for first in range(0, len(truth), segment):
        est, tru = estimate[first : first + segment, use], truth[first : first + segment, use]
        fit = similarity(est[:2].reshape(-1, 3), tru[:2].reshape(-1, 3), with_scale=False)
        moved = apply_similarity(est.reshape(-1, 3), *fit).reshape(est.shape)
        out[first : first + segment] = np.linalg.norm(moved - tru, axis=-1).mean(-1)
    return out


def scale_error(estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> float:
    """Mean estimated over mean true limb length, less 1."""
    return float(limb_lengths(estimate, joints).mean() / limb_lengths(truth, joints).mean() - 1.0)


def mirrored_frames(estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> np.ndarray:
    """(F,) bool: the mirror image of the estimate is closer to the truth than the estimate itself.

    A mirrored body can have a perfect reprojection error, so this has to be asked of the 3D poses.
    """
    return pa_mpjpe(estimate * np.array([1.0, 1.0, -1.0]), truth, joints) < pa_mpjpe(estimate, truth, joints)


def is_mirrored(estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> bool:
    """Whether a sequence as a whole is mirrored: its mirror image has the lower mean error."""
    flipped = estimate * np.array([1.0, 1.0, -1.0])
    return bool(pa_mpjpe(flipped, truth, joints).mean() < pa_mpjpe(estimate, truth, joints).mean())


def horizon_error(estimate: np.ndarray, truth: np.ndarray, joints: JointSet = BODY_15) -> np.ndarray:
    """(F,) rad, angle between the vertical of the estimate and the true one, both poses in z-up world frames.

    The estimate is rotated on the truth; how far that rotation tilts z is the error.
    """
    use = limb_indices(joints.joints)
    _, rotation, _ = similarity(estimate[:, use], truth[:, use])
    return np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0))


def group_errors(estimate: np.ndarray, truth: np.ndarray, joints: tuple[str, ...] = BODY_15.joints) -> dict[str, float]:
    """Mean error per joint group of the paper's table, after the alignment over the twelve limb joints."""
    errors = aligned_error(estimate[:, limb_indices(joints)], truth[:, limb_indices(joints)]).mean(0)
    place = {name: i for i, name in enumerate(LIMB_JOINTS)}
    return {group: float(np.mean([errors[place[j]] for j in members])) for group, members in JOINT_GROUPS.items()}
