"""Adjustment of one live window by the paper's equations (2) to (4)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.geometry.interpolation import fill_frames
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.stop_reason import TOO_SHORT
from drocap_ros.reconstruction.live.window import AdjustedWindow, Window
from drocap_ros.reconstruction.paper.bundle_adjustment import MIN_WINDOW, bundle_adjust
from drocap_ros.reconstruction.paper.expectation import expected_information
from drocap_ros.reconstruction.paper.normalize import normalize_tracks
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last
from drocap_ros.skeleton import BODY_15, BODY_17, indices

#: Least standard deviations of an adjusted pose, in units of the 2D joints: across the image, along the ray.
ACROSS_STD, DEPTH_STD = 0.02, 0.22

#: Standard deviation of 2D joints about the initial poses, in units of the 2D joints.
INITIAL_STD = 0.1

#: Factor on the variance of an unseen joint.
_UNSEEN = 4.0

#: The ankles in the order of the toes.
_ANKLES = np.array(indices(BODY_15.joints, ("rankle", "lankle")))


def adjust_by_equations(window: Window, config: BundleAdjusterConfig | None = None) -> AdjustedWindow:
    """Bundle adjustment of one window; frames whose initial pose is NaN are interpolated from their neighbours.

    The paper's method has no feet: each toe keeps its place from the ankle in the initial pose.

    Raises
    ------
    InputError
        When the arrays do not fit, show no person, or no frame has an initial pose.
    """
    config = config or BundleAdjusterConfig()
    stamp_ns, keypoints, initial_joints = window.stamp_ns, window.keypoints, window.initial_joints
    frames = len(keypoints)
    if initial_joints.shape not in _shapes(frames) or len(stamp_ns) != frames:
        raise InputError(
            f"initial_joints: expected shape {' or '.join(map(str, _shapes(frames)))} and {frames} stamps, got"
            f" {initial_joints.shape} and {len(stamp_ns)}; give one pose and stamp per image"
        )
    whole = fill_frames(stamp_ns, initial_joints)
    initial, keypoints = whole[:, : len(BODY_15)], keypoints.with_joints(len(BODY_15))
    if keypoints.covariance is not None and np.isnan(keypoints.covariance).all():
        keypoints = replace(keypoints, covariance=None)
    n = normalize_tracks(keypoints)
    projection = Projection(n.w, n.information)
    scale = _scale_to_image(initial, projection)
    # Keypoints far from the initial poses count as outliers, as in the single-view E-step.
    expected = n.w + _camera_residual(projection, initial * scale)
    information = expected_information(n.w, n.information, expected, INITIAL_STD)
    projection = Projection(n.w, information)
    seen = n.weights > 0.0
    if frames < MIN_WINDOW:
        joints, iterations, terms, stop = initial * scale, 0, dict[str, float](), TOO_SHORT
    else:
        result = bundle_adjust(n.w, information, initial * scale, config)
        joints, iterations = result.camera_shape, result.iterations
        terms, stop = result.cost_terms, result.stop_reason
    gap = _camera_residual(projection, joints)
    square = np.where(seen, np.sum(gap**2, axis=-1), 0.0)
    rms = np.sqrt(square.sum(1) / np.maximum(seen.sum(1), 1)) * n.scale_px
    joints = joints - joints[:, BODY_15.index("pelvis")][:, None]
    # The scale of a monocular result is that of the initial poses: keep the mean limb length.
    metres = float(limb_lengths(initial).mean() / limb_lengths(joints).mean())
    feet = _ANKLES[: whole.shape[1] - len(BODY_15)]
    toes = (joints * metres)[:, feet] + whole[:, len(BODY_15) :] - whole[:, feet]
    covariance = _window_covariance(gap, seen) * metres**2
    return AdjustedWindow(
        stamp_ns=np.asarray(stamp_ns, dtype=np.int64),
        joints3d=np.concatenate([joints * metres, toes], axis=1),
        covariance=np.concatenate([covariance, _UNSEEN * covariance[:, feet]], axis=1),
        confidence=np.concatenate([n.weights, np.zeros((frames, len(feet)))], axis=1),
        reprojection_rms_px=np.where(seen.any(1), rms, np.nan),
        iterations=iterations,
        cost=float(sum(terms.values())),
        stop_reason=stop,
        cost_terms=terms,
    )


def _shapes(frames: int) -> tuple[tuple[int, int, int], ...]:
    return (frames, len(BODY_15), 3), (frames, len(BODY_17), 3)


def _camera_residual(projection: Projection, joints: np.ndarray) -> np.ndarray:
    """Distance (F, P, 2) of the projected poses (F, P, 3), in camera axes, from the keypoints."""
    flat = frames_last(joints[..., :2])
    return frames_first(flat + projection.translation(flat)[:, None] - projection.w)


def _window_covariance(gap: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(F, P, 6) in squared units of the 2D joints, from the window's residuals (F, P, 2).

    Across the image: the mean square of the residuals.  Along the ray :data:`DEPTH_STD` is added, the error of
    adjusted depths on CMU training sequences at 25 deg/s (80 mm RMS, 7 mm across).  Unseen joints have twice the
    standard deviation.
    """
    square = np.where(seen, 0.5 * np.sum(gap**2, axis=-1), 0.0)
    across = square.sum() / max(int(seen.sum()), 1) + ACROSS_STD**2
    factor = np.where(seen, 1.0, _UNSEEN)
    out = np.zeros((*gap.shape[:2], 6))
    out[..., 0] = out[..., 3] = factor * across
    out[..., 5] = factor * (9.0 * across + DEPTH_STD**2)
    return out


def _scale_to_image(initial: np.ndarray, projection: Projection) -> float:
    """Factor from metres to the unit of the 2D joints, least squares over the window."""
    flat = initial[..., :2]
    weight, target = frames_first(projection.information)[..., :1], frames_first(projection.w)
    mean = np.sum(weight * flat, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    centre = np.sum(weight * target, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    x, y = flat - mean, target - centre
    spread = float(np.sum(weight * x * x))
    fitted = float(np.sum(weight * x * y)) / spread if spread > 0.0 else 0.0
    # Poses that disagree with the image altogether still have its size.
    return fitted if fitted > 0.0 else float(np.sqrt(np.sum(weight * y * y) / max(spread, 1e-12)))
