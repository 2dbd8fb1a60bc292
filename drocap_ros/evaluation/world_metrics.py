"""Error measures of a motion in the world, against the truth; poses are (F, P, 3) m, first those of BODY_15, z up.

The names and definitions are those of the world-grounded literature (EMDB, WHAM); every mean is over all given joints
unless said otherwise.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.contacts import TRUE_REST_M_S, step_speed
from drocap_ros.geometry.alignment import apply_similarity, similarity
from drocap_ros.geometry.ellipsoids import unpack_covariance
from drocap_ros.skeleton import BODY_15, indices

FEET = indices(BODY_15.joints, ("rankle", "lankle"))
#: Mean acceleration (m/s^2) below which a truth is motionless: a person who stands has tenths.
MOTIONLESS_M_S2 = 1e-3
#: Squared radius of the ellipsoid that holds 90 % of a normal distribution in three dimensions (chi-squared).
ELLIPSOID_90 = 6.2514
#: Frames per second: one number, or (F - 1) of the steps between the frames, which images left out make longer.
Rate = float | np.ndarray
_PELVIS = BODY_15.index("pelvis")


def mpjpe(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(F,) mean distance of the joints, both poses with the pelvis at the origin."""
    relative = (estimate - estimate[:, [_PELVIS]]) - (truth - truth[:, [_PELVIS]])
    return np.linalg.norm(relative, axis=-1).mean(-1)


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
    return est / tru if tru > MOTIONLESS_M_S2 else float("nan")


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
    return float((square < ELLIPSOID_90).mean())


def _of_steps(rate_hz: Rate, frames: int) -> np.ndarray:
    """Rates (F - 1, 1, 1) of the steps between the frames."""
    return np.broadcast_to(np.asarray(rate_hz, float), frames - 1)[:, None, None]
