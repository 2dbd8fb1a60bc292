"""Error measures of a reconstruction against the truth; lengths keep the unit of the input.

Poses are (F, 15, 3) of BODY_15 or (F, 17, 3) of BODY_17 unless said otherwise.  Those in the world have z up; the names
and definitions of their measures are those of the world-grounded literature (EMDB, WHAM), and every mean is over all
given joints.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.contacts import TRUE_REST_M_S, step_speed
from drocap_ros.geometry.alignment import apply_similarity, limb_lengths, similarity
from drocap_ros.geometry.rotations import unpack_covariance
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
#: Frames of W-MPJPE's segments, as in the literature.
SEGMENT = 100
#: Frames per second: one number, or (F - 1) of the steps between the frames, which images left out make longer.
Rate = float | np.ndarray
FEET = indices(BODY_15.joints, ("rankle", "lankle"))
_PELVIS = BODY_15.index("pelvis")
_LIMBS = indices(BODY_15.joints, LIMB_JOINTS)
_TOES = indices(BODY_17.joints, ("rtoe", "ltoe"))
_MIRROR = np.array([1.0, 1.0, -1.0])


def aligned_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distance (..., P) of each joint (..., P, 3) after the best similarity transformation per pose, no reflection."""
    return np.asarray(np.linalg.norm(apply_similarity(estimate, *similarity(estimate, truth)) - truth, axis=-1))


def pa_mpjpe(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The paper's reconstruction error (F,): :func:`aligned_error` averaged over the twelve limb joints."""
    return np.asarray(aligned_error(estimate[..., _LIMBS, :], truth[..., _LIMBS, :]).mean(-1))


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
    return np.asarray(np.arccos(np.clip(rotation[:, 2, 2], -1.0, 1.0)))


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


def mpjpe(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(F,) mean distance of the joints, both poses with the pelvis at the origin."""
    relative = (estimate - estimate[:, [_PELVIS]]) - (truth - truth[:, [_PELVIS]])
    return np.asarray(np.linalg.norm(relative, axis=-1).mean(-1))


def root_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """RTE: mean distance of the pelvis after one rigid alignment of its path, as a share of the true path's length."""
    est, tru = estimate[:, _PELVIS], truth[:, _PELVIS]
    moved = apply_similarity(est, *similarity(est, tru, with_scale=False))
    path = float(np.linalg.norm(np.diff(tru, axis=0), axis=1).sum())
    return float(np.linalg.norm(moved - tru, axis=1).mean()) / max(path, 1e-9)


def still_foot_speed(estimate: np.ndarray, truth: np.ndarray, rate_hz: Rate) -> float:
    """Mean speed (m/s) of the estimated ankles where the true ones move slower than ``TRUE_REST_M_S``; NaN = never."""
    still = step_speed(truth[:, FEET], rate_hz) < TRUE_REST_M_S
    return float(step_speed(estimate[:, FEET], rate_hz)[still].mean()) if still.any() else float("nan")


def penetration(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Mean depth (m) of the ankles below the lowest place of the true ones."""
    return float(np.maximum(truth[:, FEET, 2].min() - estimate[:, FEET, 2], 0.0).mean())


def accelerations(joints: np.ndarray, rate_hz: Rate) -> np.ndarray:
    """(F - 2, P, 3) m/s^2, second differences."""
    rates = _of_steps(rate_hz, len(joints))
    between = 2 / (1 / rates[1:] + 1 / rates[:-1])
    return np.diff(np.diff(joints, axis=0) * rates, axis=0) * between


def acceleration_ratio(estimate: np.ndarray, truth: np.ndarray, rate_hz: Rate) -> float:
    """Mean acceleration of the estimated joints over that of the true ones; NaN = the truth does not move."""
    est, tru = (float(np.linalg.norm(accelerations(x, rate_hz), axis=-1).mean()) for x in (estimate, truth))
    # Mean acceleration (m/s^2) below which a truth is motionless: a person who stands has tenths.
    return est / tru if tru > 1e-3 else float("nan")


def acceleration_error(estimate: np.ndarray, truth: np.ndarray, rate_hz: Rate) -> float:
    """Mean length (m/s^2) of the difference of the accelerations."""
    return float(np.linalg.norm(accelerations(estimate, rate_hz) - accelerations(truth, rate_hz), axis=-1).mean())


def ellipsoid_coverage(estimate: np.ndarray, truth: np.ndarray, covariance: np.ndarray) -> float:
    """Share of the true joints within the ellipsoid that should hold 90 % of them.

    covariance : (F, P, 6) m^2: xx, xy, xz, yy, yz, zz; joints without a finite one are left out
    """
    known = np.isfinite(covariance).all(-1)
    if not known.any():
        return float("nan")
    matrix, gap = unpack_covariance(covariance[known]), (estimate - truth)[known]
    square = np.einsum("ni,ni->n", gap, np.linalg.solve(matrix + 1e-12 * np.eye(3), gap[..., None])[..., 0])
    # Squared radius of the ellipsoid that holds 90 % of a normal distribution in three dimensions (chi-squared).
    return float((square < 6.2514).mean())


def _of_steps(rate_hz: Rate, frames: int) -> np.ndarray:
    """Rates (F - 1, 1, 1) of the steps between the frames."""
    return np.broadcast_to(np.asarray(rate_hz, float), frames - 1)[:, None, None]
