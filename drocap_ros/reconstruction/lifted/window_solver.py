"""Depth signs and adjustment of one window, in mm of an ordinary person.

The image positions are smoothed without outliers, every bone gets its depth from its length and its sign, and the
adjustment refines the result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drocap_ros.keypoints import Keypoints2D, difference_noise, nanmedian_small
from drocap_ros.reconstruction.common.poses import Evidence
from drocap_ros.reconstruction.lifted.adjustment import (
    AdjustmentProblem,
    AdjustmentSolution,
    adjust,
    span_lengths,
    zoom_model,
)
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.lifted.network import LiftedMotion
from drocap_ros.skeleton import BODY_17


def depth_signs(
    reach: np.ndarray,
    depth: np.ndarray,
    sigma: np.ndarray,
    speed: float,
    acceleration: float,
) -> np.ndarray:
    """Most plausible signs of depth differences, by dynamic programming over pairs of frames.

    reach : (F, L) >= 0, depth difference of bone l without its sign
    depth, sigma : (F, L) the lifter's depth difference and its expected absolute error
    speed, acceleration : first and second difference of the depth per frame that cost as much as one sigma
    returns : (F, L) of +1 and -1
    """
    frames, bones = reach.shape
    signs: np.ndarray = np.array([1.0, -1.0])
    state = signs * reach[..., None]
    unary = np.abs(state - depth[..., None]) / sigma[..., None]
    if frames == 1:
        only: np.ndarray = signs[unary[0].argmin(axis=-1)][None]
        return only
    move = np.abs(state[1:, :, None, :] - state[:-1, :, :, None]) / speed
    swing = state[2:, :, None, None, :] - 2 * state[1:-1, :, None, :, None] + state[:-2, :, :, None, None]
    # The bound keeps a gross error of the image length from turning the signs of the rest of the sequence.
    swing = np.minimum(np.abs(swing) / acceleration, 4.0)
    cost = unary[0][:, :, None] + unary[1][:, None, :] + move[0]
    back = np.zeros((frames, bones, 2, 2), np.int8)
    for t in range(2, frames):
        total = cost[:, :, :, None] + swing[t - 2]
        keep = total[:, 0] <= total[:, 1]
        back[t] = ~keep
        cost = np.where(keep, total[:, 0], total[:, 1]) + (move[t - 1] + unary[t][:, None, :])
    path = np.zeros((frames, bones), np.intp)
    last = cost.reshape(bones, 4).argmin(axis=1)
    path[-1], path[-2] = last % 2, last // 2
    each = np.arange(bones)
    for t in range(frames - 1, 1, -1):
        path[t - 2] = back[t, each, path[t - 1], path[t]]
    return signs[path]


#: Returns True when an adjustment should end.
Cancelled = Callable[[], bool]

_BONES = BODY_17.bones
#: What a frame's keypoints count for at these shares of fresh noise.  Noise that lasts repeats itself from frame to
#: frame: of a share s the information of each is worth s / (2 - s), as for a first-order autoregressive process; at
#: the least shares the errors of the lifter are what lasts.
_REPEATED_AT, _REPEATED_WORTH = (0.2, 0.3, 0.47, 0.6), (1.0, 0.3, 0.3, 1.0)


@dataclass(frozen=True)
class WindowModel:
    """Weights and priors common to both adjustments of a window.

    information : (F, 17, 3) 1/mm^2, xx, xy, yy of the 2D joints' inverse covariance, less where their errors last from
        frame to frame, 0 where not seen
    noise_mm, lasting_noise_mm : standard deviation of their errors, and of those that last for some frames
    fresh_share : share of the squared distance from the lifter's places that is fresh in every frame
    """

    information: np.ndarray
    noise_mm: float
    lasting_noise_mm: float
    fresh_share: float
    fps: float
    config: LiftedConfig
    zoom_basis: np.ndarray
    zoom_precision: np.ndarray


def window_model(
    keypoints: Keypoints2D, place: np.ndarray, mm: float, fps: float, config: LiftedConfig, interleaved: int = 1
) -> WindowModel:
    """Model of a window whose keypoints have ``mm`` per unit.

    Without a covariance the noise comes from the change between two frames of the keypoints' distance from the lifter's
    places (F, 17, 2), in their unit: the body's motion does not enter.  ``interleaved`` : of the lifter.
    """
    points_mm, confidence = keypoints.xy * mm, keypoints.confidence
    seen = np.isfinite(points_mm[..., 0])
    fresh, whole = _gap_noise(points_mm - place * mm, interleaved)
    share = (fresh / whole) ** 2 if whole > 0 else 0.0
    noise = max(config.noise_mm, min(whole, config.lasting_factor * fresh))
    covariance = np.broadcast_to(noise**2 * np.array([1.0, 0.0, 1.0]), (*seen.shape, 3))
    if keypoints.covariance is not None:
        known = np.isfinite(keypoints.covariance).all(axis=-1, keepdims=True)
        covariance = np.where(
            known, _at_least(np.nan_to_num(keypoints.covariance) * mm**2, config.noise_mm), covariance
        )
        noise = float(np.sqrt(np.median(0.5 * (covariance[seen, 0] + covariance[seen, 2])))) if seen.any() else noise
    determinant = covariance[..., 0] * covariance[..., 2] - np.square(covariance[..., 1])
    weight = seen / determinant * np.interp(share, _REPEATED_AT, _REPEATED_WORTH)
    if confidence is not None:
        weight = weight * np.clip(np.nan_to_num(confidence), 0.0, 1.0)
    information = weight[..., None] * covariance[..., [2, 1, 0]] * np.array([1.0, -1.0, 1.0])
    lasting = _lasting_noise(points_mm)
    return WindowModel(
        information, noise, lasting, share, fps, config, *zoom_model(len(keypoints), fps, config.zoom_std_per_s)
    )


def _at_least(covariance: np.ndarray, std: float) -> np.ndarray:
    """Covariances (..., 3) whose smallest standard deviation is at least ``std``."""
    middle, half = 0.5 * (covariance[..., 0] + covariance[..., 2]), 0.5 * (covariance[..., 0] - covariance[..., 2])
    smallest = middle - np.hypot(half, covariance[..., 1])
    wider: np.ndarray = covariance + np.maximum(std**2 - smallest, 0.0)[..., None] * np.array([1.0, 0.0, 1.0])
    return wider


def _gap_noise(gap: np.ndarray, stride: int) -> tuple[float, float]:
    """Standard deviations of what changes within ``stride`` frames in gaps (F, P, 2), and of the gaps, no less.

    The lifter takes the frames of a fast video as ``stride`` sequences, whose places differ.
    """
    if len(gap) <= stride:
        return 0.0, 0.0
    change = (gap[stride:] - gap[:-stride]) / np.sqrt(2.0)
    fresh, whole = (
        1.48 * float(np.nan_to_num(nanmedian_small(np.abs(values).reshape(-1), axis=0))) for values in (change, gap)
    )
    return fresh, max(fresh, whole)


def _lasting_noise(points: np.ndarray) -> float:
    """Noise of points (F, P, 2) that lasts for more than one frame: no smoothing removes it."""
    if len(points) < 8:
        return 0.0
    all_frames, every_second = (difference_noise(points[::stride]) for stride in (1, 2))
    return float(np.sqrt(max(every_second**2 - all_frames**2, 0.0)))


def solve_signs_and_adjust(
    model: WindowModel,
    keypoints: np.ndarray,
    lifted: LiftedMotion,
    lengths: np.ndarray | None,
    iterations: int,
    cancelled: Cancelled | None,
    evidence: Evidence | None = None,
) -> AdjustmentSolution:
    """Adjusted joints from the 2D joints (F, 17, 2) and the lifter's result, all in mm.

    lengths : (18,) of the adjustment's spans; None = from the 2D joints and the lifter's depths
    evidence : poses of the same frames by another method, any unit
    """
    config, fps = model.config, model.fps
    prior, sigma = lifted.joints, lifted.sigma
    others = None if evidence is None else evidence.depths(prior)
    if others is not None:
        prior, sigma = _with_evidence(prior, sigma, *others)
    weight = 0.5 * (model.information[..., 0] + model.information[..., 2])
    points = np.where(weight[..., None] > 0, np.nan_to_num(keypoints), 0.0)
    prior_xy = config.image_weight / (2 * np.square(sigma[..., 0]) + 5.0**2)
    prior_xy[weight > 0] *= _where_fresh(model, 1.0, config.fresh_weight)
    gap = np.square(points - prior[..., :2]).sum(axis=-1)
    inlier = gap < 9 * (2 * model.noise_mm**2 + 2 * np.square(sigma[..., 0]) + 8.0**2)
    smoothing = (1000 * config.smoothing_std_m_s2 / fps**2) ** -2
    flat = _smooth(points, weight * inlier, prior[..., :2], prior_xy, smoothing)

    image = span_lengths(flat)
    length_weight = 0.0 if lengths is None else (model.lasting_noise_mm / config.held_noise_mm) ** 2
    if lengths is None:
        seen_lengths = np.median(span_lengths(np.concatenate([flat, prior[..., 2:]], axis=-1)), axis=0)
        # A bone is at least as long as its image, up to the noise.
        lengths = np.maximum(seen_lengths, np.quantile(image, 0.97, axis=0))
    reach = np.sqrt(np.maximum(np.square(lengths) - np.square(image), 0.0))[:, : len(_BONES)]
    parent, child = _BONES[:, 0], _BONES[:, 1]
    spread = np.hypot(sigma[:, parent, 1], sigma[:, child, 1])
    sign = depth_signs(
        reach,
        prior[:, child, 2] - prior[:, parent, 2],
        np.maximum(spread, 1e-3),
        1000 * config.sign_speed_m_s / fps,
        1000 * config.sign_acceleration_m_s2 / fps**2,
    )
    depth = np.zeros(flat.shape[:2])
    # Where the lifter sees a bone flatter than its length says, it starts as it is seen.
    start = sign * np.minimum(reach, np.abs(prior[:, child, 2] - prior[:, parent, 2]))
    for bone, (p, c) in enumerate(_BONES):
        depth[:, c] = depth[:, p] + start[:, bone]
    problem = AdjustmentProblem(
        keypoints=points,
        information=model.information,
        prior=prior,
        prior_weight_xy=prior_xy,
        prior_weight_z=config.depth_weight / np.maximum(sigma[..., 1], 10.0),
        acceleration_weight=(1000 * config.acceleration_std_m_s2 / fps**2) ** -2,
        zoom_basis=model.zoom_basis,
        zoom_precision=model.zoom_precision,
        lengths=lengths,
        length_weight=length_weight,
        outlier_square=_where_fresh(model, config.outlier_square, config.fresh_outlier_square),
    )
    return adjust(problem, np.concatenate([flat, depth[..., None]], axis=-1), iterations, cancelled=cancelled)


def _with_evidence(
    prior: np.ndarray, sigma: np.ndarray, depth: np.ndarray, deviation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The lifter's joints and errors with depths (F, P) of others, weighted by their precisions; places stay."""
    own, other = sigma[..., 1] ** -2.0, deviation**-2.0
    both = own + other
    mixed, less = prior.copy(), sigma.copy()
    mixed[..., 2] = np.where(other > 0, (own * prior[..., 2] + other * np.nan_to_num(depth)) / both, prior[..., 2])
    mixed[..., 2] -= mixed[:, :1, 2]
    less[..., 1] = both**-0.5
    return mixed, less


def _where_fresh(model: WindowModel, lasting: float, fresh: float) -> float:
    """A value between those for noise that lasts and for noise that is fresh in every frame."""
    config = model.config
    return float(np.interp(model.fresh_share, (config.fresh_from, config.fresh_to), (lasting, fresh)))


def _smooth(
    points: np.ndarray, weight: np.ndarray, other: np.ndarray, other_weight: np.ndarray, smoothing: float
) -> np.ndarray:
    """Least-squares fit (F, 17, 2) to two noisy tracks with small accelerations: a banded solve per joint."""
    from scipy.linalg import solveh_banded

    frames, joints, _ = points.shape
    band = np.zeros((3, frames))
    if frames > 2:
        for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
            band[2, offset : frames - 2 + offset] += factor * smoothing
        band[1, 1:-1] -= 2 * smoothing
        band[1, 2:] -= 2 * smoothing
        band[0, 2:] += smoothing
    out = np.empty_like(points)
    for j in range(joints):
        matrix = band.copy()
        matrix[2] += weight[:, j] + other_weight[:, j]
        right = weight[:, j, None] * points[:, j] + other_weight[:, j, None] * other[:, j]
        out[:, j] = solveh_banded(matrix, right)
    return out
