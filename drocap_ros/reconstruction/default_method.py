"""The default method: a learned start, signs of depth over time, and limbs of constant length.

1. The lifter proposes joints and their expected errors.
2. Bones keep their length, so each reaches a known distance in depth; its sign follows from the lifter's
   opinion over the whole window (:mod:`depth_signs`).
3. All joints and bone lengths are adjusted together (:mod:`limb_adjustment`).
4. The lifter looks again, told the bone lengths, and steps 2 and 3 are done from its second opinion.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.depth_signs import depth_signs
from drocap_ros.reconstruction.lifter import LiftedMotion, Lifter
from drocap_ros.reconstruction.lifter_input import LIFTER_FPS, nanmedian_small
from drocap_ros.reconstruction.limb_adjustment import (
    LimbProblem,
    LimbResult,
    adjust_limbs,
    span_lengths,
)
from drocap_ros.skeleton import BODY_15

_BONES = BODY_15.bones
#: Bones whose sum is the yardstick that turns image units into mm of an ordinary person.
_YARDSTICK = [0, 1, 2, 6, 7]
_YARDSTICK_MM = 1550.0


@dataclass(frozen=True)
class DefaultMethodConfig(Parameters):
    """Weights of the default method; "mm" are those of a person of ordinary size."""

    lifter: str = param("", "lifter's ONNX file; empty for the shipped one")
    first_iterations: int = param(4, "steps that find the bone lengths", minimum=0, maximum=1000)
    iterations: int = param(8, "steps of the final adjustment", minimum=0, maximum=1000)
    noise_mm: float = param(2.0, "least standard deviation of a 2D joint", unit="mm", minimum=0.01, maximum=100.0)
    depth_weight: float = param(0.2, "weight of the lifter's depth", minimum=0.0, maximum=100.0)
    image_weight: float = param(1.0, "weight of the lifter's image position", minimum=0.0, maximum=100.0)
    acceleration_std_m_s2: float = param(8.4, "ordinary acceleration", unit="m/s^2", minimum=0.01, maximum=1000.0)
    smoothing_std_m_s2: float = param(
        10.0, "ordinary acceleration in the image when outliers are sought", unit="m/s^2", minimum=0.01, maximum=1000.0
    )
    sign_speed_m_s: float = param(
        1.44, "speed of a bone's end in depth that costs one sigma", unit="m/s", minimum=0.01, maximum=100.0
    )
    sign_acceleration_m_s2: float = param(
        14.4, "its acceleration that costs one sigma", unit="m/s^2", minimum=0.01, maximum=1000.0
    )


@dataclass(frozen=True)
class DefaultResult:
    """A window's result.

    joints : (F, 15, 3) in camera axes and the unit of the keypoints, x and y in the image
    sigma : (F, 15, 2) the lifter's expected absolute error of x, y (each) and of depth, in the same unit
    lengths : (14,) bone lengths in the same unit (joint j to its parent at j - 1)
    seconds : wall-clock of "initial" (the lifter) and of "ba" (the rest)
    """

    joints: np.ndarray
    sigma: np.ndarray
    lengths: np.ndarray
    cost_terms: dict[str, float]
    iterations: int
    stop_reason: str
    seconds: dict[str, float]


def default_start_and_refine(
    keypoints: np.ndarray,
    confidence: np.ndarray | None = None,
    variance: np.ndarray | None = None,
    fps: float = LIFTER_FPS,
    config: DefaultMethodConfig | None = None,
    lifter: Lifter | None = None,
) -> DefaultResult:
    """Poses of one window of evenly spaced frames.

    Parameters
    ----------
    keypoints : (F, 15, 2) of ``BODY_15``, any unit, y down; NaN where not seen
    confidence : (F, 15) in [0, 1], or None
    variance : (F, 15) of each coordinate in the keypoints' unit squared, or None (estimated from the sequence)
    fps : frames per second
    config, lifter : the defaults if None

    Raises
    ------
    InputError
        When no joint is ever seen.
    """
    config = config or DefaultMethodConfig()
    lifter = lifter or Lifter.load(config.lifter or None)
    clock = time.perf_counter()
    first = lifter.lift(keypoints, confidence, fps)
    seconds = {"initial": time.perf_counter() - clock, "ba": 0.0}
    clock = time.perf_counter()
    mm = _YARDSTICK_MM / max(float(np.median(_bone_lengths(first.joints), axis=0)[_YARDSTICK].sum()), 1e-12)
    weight, noise = _weights(keypoints * mm, confidence, variance, mm, config)
    look = _look(keypoints, first, mm)
    result = _solve(look, weight, noise, None, fps, config, config.first_iterations)
    seconds["ba"] = time.perf_counter() - clock

    clock = time.perf_counter()
    lengths = result.lengths
    second = lifter.lift(keypoints, confidence, fps, lengths[: len(_BONES)] / mm)
    seconds["initial"] += time.perf_counter() - clock
    clock = time.perf_counter()
    look = _look(keypoints, second, mm)
    result = _solve(look, weight, noise, lengths, fps, config, config.iterations)
    joints = result.joints / mm
    joints[..., :2] += look.centre[:, None]
    seconds["ba"] += time.perf_counter() - clock
    return DefaultResult(
        joints=joints,
        sigma=second.sigma,
        lengths=result.lengths[: len(_BONES)] / mm,
        cost_terms=result.cost_terms,
        iterations=result.iterations,
        stop_reason=result.stop_reason,
        seconds=seconds,
    )


def default_poses(
    stamp_ns: np.ndarray,
    keypoints: np.ndarray,
    confidence: np.ndarray | None,
    variance: np.ndarray | None,
    config: DefaultMethodConfig,
) -> DefaultResult:
    """:func:`default_start_and_refine` for frames at any increasing times ``stamp_ns`` (F,).

    Frames that were dropped are put back as frames without a joint, so that time runs evenly.
    """
    slot, fps = even_slots(stamp_ns)
    if slot[-1] + 1 == len(slot):
        return default_start_and_refine(keypoints, confidence, variance, fps, config)

    def spread(values: np.ndarray | None, empty: float) -> np.ndarray | None:
        if values is None:
            return None
        out = np.full((slot[-1] + 1, *values.shape[1:]), empty)
        out[slot] = values
        return out

    points = spread(keypoints, np.nan)
    assert points is not None
    r = default_start_and_refine(points, spread(confidence, 0.0), spread(variance, np.nan), fps, config)
    return replace(r, joints=r.joints[slot], sigma=r.sigma[slot])


def even_slots(stamp_ns: np.ndarray) -> tuple[np.ndarray, float]:
    """Place (F,) of each frame on an even grid of the usual frame time, and the frames per second.

    A pause counts as at most a second, and the grid has at most four places per frame.
    """
    if len(stamp_ns) < 2:
        return np.zeros(len(stamp_ns), np.intp), LIFTER_FPS
    step = np.diff(stamp_ns).astype(np.float64)
    usual = float(np.median(step))
    fps = float(np.clip(1e9 / usual, 1.0, 1000.0))
    places = np.clip(np.round(step / usual), 1, max(round(fps), 1)).astype(np.intp)
    if places.sum() > 4 * len(stamp_ns):
        places[:] = 1
    return np.concatenate([[0], np.cumsum(places)]), fps


@dataclass(frozen=True)
class _Look:
    """2D joints and the lifter's opinion in mm about each frame's centre (F, 2), which is in image units."""

    keypoints: np.ndarray
    joints: np.ndarray
    sigma: np.ndarray
    centre: np.ndarray


def _look(keypoints: np.ndarray, lifted: LiftedMotion, mm: float) -> _Look:
    centre = np.median(lifted.joints[..., :2], axis=1)
    joints = lifted.joints.copy()
    joints[..., :2] -= centre[:, None]
    return _Look((keypoints - centre[:, None]) * mm, joints * mm, lifted.sigma * mm, centre)


def _bone_lengths(joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(joints[..., _BONES[:, 1], :] - joints[..., _BONES[:, 0], :], axis=-1)


def _weights(
    keypoints: np.ndarray,
    confidence: np.ndarray | None,
    variance: np.ndarray | None,
    mm: float,
    config: DefaultMethodConfig,
) -> tuple[np.ndarray, float]:
    """Weights (F, 15) of the 2D joints in 1/mm^2, 0 where not seen, and the sequence's noise in mm.

    Without variances the noise is what the third difference in time shows; motion hardly does.
    """
    seen = np.isfinite(keypoints[..., 0])
    noise = config.noise_mm
    if len(keypoints) > 3:
        third = nanmedian_small(np.abs(np.diff(keypoints, n=3, axis=0)).reshape(-1), axis=0)
        noise = max(noise, 1.48 / np.sqrt(20) * float(np.nan_to_num(third)))
    square = np.full(seen.shape, noise**2)
    if variance is not None:
        square = np.where(np.isfinite(variance), np.maximum(variance * mm**2, config.noise_mm**2), square)
        noise = float(np.sqrt(np.median(square[seen]))) if seen.any() else noise
    weight = np.where(seen, 1.0 / square, 0.0)
    if confidence is not None:
        weight = weight * np.clip(np.nan_to_num(confidence), 0.0, 1.0)
    return weight, noise


def _solve(
    look: _Look,
    weight: np.ndarray,
    noise: float,
    lengths: np.ndarray | None,
    fps: float,
    config: DefaultMethodConfig,
    iterations: int,
) -> LimbResult:
    points = np.where(weight[..., None] > 0, np.nan_to_num(look.keypoints), 0.0)
    prior_xy = config.image_weight / (2 * np.square(look.sigma[..., 0]) + 5.0**2)
    gap = np.square(points - look.joints[..., :2]).sum(axis=-1)
    sane = gap < 9 * (2 * noise**2 + 2 * np.square(look.sigma[..., 0]) + 8.0**2)
    smoothing = (1000 * config.smoothing_std_m_s2 / fps**2) ** -2
    flat = _smooth(points, weight * sane, look.joints[..., :2], prior_xy, smoothing)

    image = span_lengths(flat)
    if lengths is None:
        seen_lengths = np.median(span_lengths(np.concatenate([flat, look.joints[..., 2:]], axis=-1)), axis=0)
        # A bone is at least as long as it is seen, but for the noise.
        lengths = np.maximum(seen_lengths, np.quantile(image, 0.97, axis=0))
    reach = np.sqrt(np.maximum(np.square(lengths) - np.square(image), 0.0))[:, : len(_BONES)]
    parent, child = _BONES[:, 0], _BONES[:, 1]
    sigma = np.hypot(look.sigma[:, parent, 1], look.sigma[:, child, 1])
    sign = depth_signs(
        reach,
        look.joints[:, child, 2] - look.joints[:, parent, 2],
        np.maximum(sigma, 1e-3),
        1000 * config.sign_speed_m_s / fps,
        1000 * config.sign_acceleration_m_s2 / fps**2,
    )
    depth = np.zeros(flat.shape[:2])
    for bone, (p, c) in enumerate(_BONES):
        depth[:, c] = depth[:, p] + sign[:, bone] * reach[:, bone]
    problem = LimbProblem(
        keypoints=points,
        weight=weight,
        prior=look.joints,
        prior_weight_xy=prior_xy,
        prior_weight_z=config.depth_weight / np.maximum(look.sigma[..., 1], 10.0),
        acceleration_weight=(1000 * config.acceleration_std_m_s2 / fps**2) ** -2,
    )
    return adjust_limbs(problem, np.concatenate([flat, depth[..., None]], axis=-1), lengths, iterations)


def _smooth(
    points: np.ndarray, weight: np.ndarray, other: np.ndarray, other_weight: np.ndarray, smoothing: float
) -> np.ndarray:
    """Least-squares compromise (F, 15, 2) of two noisy tracks that accelerates little: a banded solve per joint."""
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
