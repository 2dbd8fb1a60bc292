"""The default method: a learned start, signs of depth over time, and limbs of constant length.

1. The lifter proposes joints and their expected errors.
2. Bones keep their length, so each reaches a known distance in depth; its sign follows from the lifter's
   opinion over the whole window (:mod:`depth_signs`).
3. All joints and bone lengths are adjusted together (:mod:`limb_adjustment`).
4. The lifter looks again, told the bone lengths, and steps 2 and 3 are done from its second opinion.

Where the person's bone lengths and size in the image are known from the window before, the first look and the first
adjustment are left out: a warm start costs half.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.parameters import Parameters, param
from drocap_ros.reconstruction.lifted.depth_signs import depth_signs
from drocap_ros.reconstruction.lifted.lifter import LiftedMotion, Lifter
from drocap_ros.reconstruction.lifted.lifter_input import LIFTER_FPS, nanmedian_small
from drocap_ros.reconstruction.lifted.limb_adjustment import (
    LimbProblem,
    LimbResult,
    adjust_limbs,
    span_lengths,
    zoom_model,
)
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig
from drocap_ros.skeleton import BODY_15

#: Says whether an adjustment should end.
Cancelled = Callable[[], bool]

_BONES = BODY_15.bones
#: Bones whose sum is the yardstick that turns image units into mm of an ordinary person.
_YARDSTICK = [0, 1, 2, 6, 7]
_YARDSTICK_MM = 1550.0


@dataclass(frozen=True)
class LiftedConfig(Parameters):
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
    zoom_std_per_s: float = param(
        0.01, "relative change of the person's size in the image per second", minimum=1e-6, maximum=1.0
    )
    sign_speed_m_s: float = param(
        1.44, "speed of a bone's end in depth that costs one sigma", unit="m/s", minimum=0.01, maximum=100.0
    )
    sign_acceleration_m_s2: float = param(
        14.4, "its acceleration that costs one sigma", unit="m/s^2", minimum=0.01, maximum=1000.0
    )


def lifted_config(adjuster: BundleAdjusterConfig) -> LiftedConfig:
    """The method's parameters where the adjuster's section sets them; weights are the defaults."""
    return LiftedConfig(
        lifter=adjuster.lifter, first_iterations=adjuster.limb_iterations_first, iterations=adjuster.limb_iterations
    )


def prepare(config: LiftedConfig) -> None:
    """Load what a first window would wait for.

    Raises
    ------
    InputError
        When ``config.lifter`` is no lifter.
    """
    import_libraries()
    Lifter.load(config.lifter or None)


def import_libraries() -> None:
    """Import what takes long and is not needed by those who only name the method."""
    import scipy.linalg.lapack
    import scipy.ndimage  # noqa: F401


@dataclass(frozen=True)
class BodySize:
    """What an earlier window knows of the person.

    lengths_mm : (16,) of :data:`~drocap_ros.reconstruction.lifted.limb_adjustment.SPANS`, in mm of an ordinary person
    unit_per_mm : (F,) the person's size in the image of each frame: units of the keypoints per such mm
    """

    lengths_mm: np.ndarray
    unit_per_mm: np.ndarray


@dataclass(frozen=True)
class WindowSolution:
    """A window's result.

    joints : (F, 15, 3) in camera axes and the unit of the keypoints; x and y where the joint is in the image, depth
        in the scale of the pelvis
    sigma : (F, 15, 2) the lifter's expected absolute error of x, y (each) and of depth, in the same unit
    lengths : (14,) bone lengths in the same unit (joint j to its parent at j - 1)
    body : for a warm start of the next window
    steps : that the first and the final adjustment took
    seconds : wall-clock of "initial" (the lifter) and of "ba" (the rest)
    """

    joints: np.ndarray
    sigma: np.ndarray
    lengths: np.ndarray
    body: BodySize
    cost_terms: dict[str, float]
    iterations: int
    steps: tuple[int, int]
    stop_reason: str
    seconds: dict[str, float]


def solve_even_window(
    keypoints: Keypoints2D,
    fps: float = LIFTER_FPS,
    focal: float | None = None,
    config: LiftedConfig | None = None,
    lifter: Lifter | None = None,
    known: BodySize | None = None,
    cancelled: Cancelled | None = None,
) -> WindowSolution:
    """Poses of one window of evenly spaced frames.

    Parameters
    ----------
    keypoints : of ``BODY_15``, any unit, y down; without a covariance the noise is estimated from the sequence
    fps : frames per second
    focal : focal length in the keypoints' unit; None = unknown, and the camera is taken to be far away
    config, lifter : the defaults if None
    known : sizes from an earlier window, for a warm start
    cancelled : asked before every step of the adjustments but the first; once it says True, they end

    Raises
    ------
    InputError
        When no joint is ever seen.
    """
    config = config or LiftedConfig()
    lifter = lifter or Lifter.load(config.lifter or None)
    begin = time.perf_counter()
    if known is None:
        sized = _sized(keypoints, fps, focal, config, lifter, cancelled)
    else:
        sized = _sized_by(known, keypoints, fps, focal, config, lifter)
    setting, mm, zoom = sized.setting, sized.mm, sized.zoom

    clock = time.perf_counter()
    found = _solve(
        setting, sized.flat, sized.lifted.joints, sized.lifted.sigma, sized.lengths, config.iterations, cancelled
    )
    size = (zoom / mm)[:, None, None]
    joints = found.joints.copy()
    if focal is not None:
        joints[..., :2] /= _magnification(joints[..., 2] - joints[:, :1, 2], focal * mm / zoom)
    joints *= size
    joints[..., :2] += sized.centre[:, None]
    end = time.perf_counter()
    adjusting = sized.seconds + end - clock
    yardstick = _YARDSTICK_MM / max(float(found.lengths[_YARDSTICK].sum()), 1e-12)
    return WindowSolution(
        joints=joints,
        sigma=sized.lifted.sigma * size,
        lengths=found.lengths[: len(_BONES)] / mm,
        body=BodySize(found.lengths * yardstick, zoom * found.zoom / (mm * yardstick)),
        cost_terms=found.cost_terms,
        iterations=found.iterations,
        steps=(sized.iterations, found.iterations),
        stop_reason=found.stop_reason,
        seconds={"initial": end - begin - adjusting, "ba": adjusting},
    )


@dataclass(frozen=True)
class _Sized:
    """A window whose person's size and bone lengths are known, before the final adjustment.

    flat : (F, 15, 2) mm, the keypoints as a distant camera would see them about ``centre`` (F, 2)
    lifted : what the lifter, told the lengths (16,) mm, makes of it
    zoom : (F,) the person's relative size; ``mm`` per unit of the keypoints at zoom 1
    seconds, iterations : spent on adjusting so far
    """

    setting: _Setting
    flat: np.ndarray
    lifted: LiftedMotion
    lengths: np.ndarray
    centre: np.ndarray
    zoom: np.ndarray
    mm: float
    seconds: float
    iterations: int


def _sized(
    keypoints: Keypoints2D,
    fps: float,
    focal: float | None,
    config: LiftedConfig,
    lifter: Lifter,
    cancelled: Cancelled | None,
) -> _Sized:
    """Sizes from the lifter's first opinion and a first adjustment."""
    lifted = lifter.lift(keypoints.xy, keypoints.confidence, fps)
    clock = time.perf_counter()
    mm = _YARDSTICK_MM / max(float(np.median(_bone_lengths(lifted.joints), axis=0)[_YARDSTICK].sum()), 1e-12)
    weight, noise = _weights(keypoints, mm, config)
    setting = _Setting(weight, noise, fps, config, *zoom_model(len(keypoints), fps, config.zoom_std_per_s))
    centre = np.median(lifted.joints[..., :2], axis=1)
    zoom = _zoom_of(lifted.joints, fps)
    start = lifted.joints.copy()
    start[..., :2] -= centre[:, None]
    start *= mm / zoom[:, None, None]
    flat = _orthographic(keypoints.xy, start[..., 2], centre, zoom, mm, focal)
    found = _solve(setting, flat, start, lifted.sigma * mm, None, config.first_iterations, cancelled)
    zoom = zoom * found.zoom
    flat = _orthographic(keypoints.xy, found.joints[..., 2] - found.joints[:, :1, 2], centre, zoom, mm, focal)
    seconds = time.perf_counter() - clock
    lifted = lifter.lift(flat, keypoints.confidence, fps, found.lengths[: len(_BONES)])
    return _Sized(setting, flat, lifted, found.lengths, centre, zoom, mm, seconds, found.iterations)


def _sized_by(
    known: BodySize,
    keypoints: Keypoints2D,
    fps: float,
    focal: float | None,
    config: LiftedConfig,
    lifter: Lifter,
) -> _Sized:
    """Sizes of an earlier window."""
    mm = 1.0 / float(np.median(known.unit_per_mm))
    zoom = known.unit_per_mm * mm
    lengths = known.lengths_mm[: len(_BONES)]
    rough = _orthographic(keypoints.xy, np.zeros(keypoints.xy.shape[:2]), np.zeros((len(keypoints), 2)), zoom, mm, None)
    lifted = lifter.lift(rough, keypoints.confidence, fps, lengths)
    middle = np.median(lifted.joints[..., :2], axis=1)
    centre = middle * (zoom / mm)[:, None]
    joints = lifted.joints.copy()
    joints[..., :2] -= middle[:, None]
    flat = _orthographic(keypoints.xy, joints[..., 2], centre, zoom, mm, focal)
    weight, noise = _weights(keypoints, mm, config)
    setting = _Setting(weight, noise, fps, config, *zoom_model(len(keypoints), fps, config.zoom_std_per_s))
    return _Sized(
        setting, flat, LiftedMotion(joints, lifted.sigma), known.lengths_mm, centre, zoom, mm, seconds=0.0, iterations=0
    )


def solve_window(
    stamp_ns: np.ndarray,
    keypoints: Keypoints2D,
    focal: float | None,
    config: LiftedConfig,
    known: BodySize | None = None,
    cancelled: Cancelled | None = None,
) -> WindowSolution:
    """:func:`solve_even_window` for frames at any increasing times ``stamp_ns`` (F,).

    Frames that were dropped are put back as frames without a joint, so that time runs evenly.
    """
    slot, fps = even_slots(stamp_ns)
    if slot[-1] + 1 == len(slot):
        return solve_even_window(keypoints, fps, focal, config, known=known, cancelled=cancelled)
    if known is not None:
        size = np.interp(np.arange(slot[-1] + 1), slot, known.unit_per_mm)
        known = replace(known, unit_per_mm=size)
    even = Keypoints2D(
        _spread(keypoints.xy, slot, np.nan),
        None if keypoints.confidence is None else _spread(keypoints.confidence, slot, 0.0),
        None if keypoints.covariance is None else _spread(keypoints.covariance, slot, np.nan),
    )
    r = solve_even_window(even, fps, focal, config, known=known, cancelled=cancelled)
    body = replace(r.body, unit_per_mm=r.body.unit_per_mm[slot])
    return replace(r, joints=r.joints[slot], sigma=r.sigma[slot], body=body)


def _spread(values: np.ndarray, slot: np.ndarray, empty: float) -> np.ndarray:
    """Values (F, ...) at their slots of the even grid, ``empty`` elsewhere."""
    out = np.full((slot[-1] + 1, *values.shape[1:]), empty)
    out[slot] = values
    return out


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
class _Setting:
    """What both adjustments of a window share; weight (F, 15) in 1/mm^2 of the 2D joints, 0 where not seen."""

    weight: np.ndarray
    noise_mm: float
    fps: float
    config: LiftedConfig
    zoom_basis: np.ndarray
    zoom_precision: np.ndarray


def _orthographic(
    keypoints: np.ndarray, depth_mm: np.ndarray, centre: np.ndarray, zoom: np.ndarray, mm: float, focal: float | None
) -> np.ndarray:
    """(F, 15, 2) mm, where a distant camera would see the joints about each frame's centre (F, 2).

    ``mm`` per unit of the keypoints at zoom 1.  With the focal length the pelvis' distance is known from the
    scale, and joints that are ``depth_mm`` (F, 15) behind the pelvis are moved out, those before it in.
    """
    flat = (keypoints - centre[:, None]) * (mm / zoom)[:, None, None]
    if focal is None:
        return flat
    return flat * _magnification(depth_mm, focal * mm / zoom)


def _magnification(depth_mm: np.ndarray, distance_mm: np.ndarray) -> np.ndarray:
    """(F, 15, 1) true over seen distance from the axis for joints behind the pelvis, which is at (F,) mm."""
    return np.maximum(1.0 + depth_mm / distance_mm[:, None], 0.2)[..., None]


def _zoom_of(joints: np.ndarray, fps: float) -> np.ndarray:
    """(F,) relative size of the lifter's bodies (F, 15, 3) over time, smooth, of median 1."""
    from scipy.ndimage import gaussian_filter1d

    size = _bone_lengths(joints).sum(axis=-1)
    smooth = gaussian_filter1d(size, 1.0 * fps, mode="nearest", truncate=3.0)
    change = np.log(np.maximum(smooth / max(float(np.median(smooth)), 1e-12), 1e-3))
    # The lifter's sizes err by some percent: small changes are left to the adjustment to find.
    return np.exp(np.sign(change) * np.maximum(np.abs(change) - 0.03, 0.0))


def _bone_lengths(joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(joints[..., _BONES[:, 1], :] - joints[..., _BONES[:, 0], :], axis=-1)


def _weights(
    keypoints: Keypoints2D,
    mm: float,
    config: LiftedConfig,
) -> tuple[np.ndarray, float]:
    """Weights (F, 15) of the 2D joints in 1/mm^2, 0 where not seen, and the sequence's noise in mm.

    Without variances the noise is what the third difference in time shows; motion hardly does.
    """
    points_mm, confidence, variance = keypoints.xy * mm, keypoints.confidence, keypoints.variance
    seen = np.isfinite(points_mm[..., 0])
    noise = config.noise_mm
    if len(keypoints) > 3:
        third = nanmedian_small(np.abs(np.diff(points_mm, n=3, axis=0)).reshape(-1), axis=0)
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
    setting: _Setting,
    keypoints: np.ndarray,
    prior: np.ndarray,
    sigma: np.ndarray,
    lengths: np.ndarray | None,
    iterations: int,
    cancelled: Cancelled | None,
) -> LimbResult:
    """Signs and adjustment of 2D joints (F, 15, 2) and the lifter's joints (F, 15, 3), all in mm."""
    config, weight, fps = setting.config, setting.weight, setting.fps
    points = np.where(weight[..., None] > 0, np.nan_to_num(keypoints), 0.0)
    prior_xy = config.image_weight / (2 * np.square(sigma[..., 0]) + 5.0**2)
    gap = np.square(points - prior[..., :2]).sum(axis=-1)
    sane = gap < 9 * (2 * setting.noise_mm**2 + 2 * np.square(sigma[..., 0]) + 8.0**2)
    smoothing = (1000 * config.smoothing_std_m_s2 / fps**2) ** -2
    flat = _smooth(points, weight * sane, prior[..., :2], prior_xy, smoothing)

    image = span_lengths(flat)
    if lengths is None:
        seen_lengths = np.median(span_lengths(np.concatenate([flat, prior[..., 2:]], axis=-1)), axis=0)
        # A bone is at least as long as it is seen, but for the noise.
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
    for bone, (p, c) in enumerate(_BONES):
        depth[:, c] = depth[:, p] + sign[:, bone] * reach[:, bone]
    problem = LimbProblem(
        keypoints=points,
        weight=weight,
        prior=prior,
        prior_weight_xy=prior_xy,
        prior_weight_z=config.depth_weight / np.maximum(sigma[..., 1], 10.0),
        acceleration_weight=(1000 * config.acceleration_std_m_s2 / fps**2) ** -2,
        zoom_basis=setting.zoom_basis,
        zoom_precision=setting.zoom_precision,
    )
    return adjust_limbs(
        problem, np.concatenate([flat, depth[..., None]], axis=-1), lengths, iterations, cancelled=cancelled
    )


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
