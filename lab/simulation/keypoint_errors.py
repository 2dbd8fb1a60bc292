"""Errors of a 2D pose detector on the simulated person: noise, outliers, misses, confidence and covariance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.simulation.pinhole import project, to_camera
from drocap_ros.skeleton import BODY_15, BODY_17

#: Standard deviation over the box height, per kind of joint (detectors are worst at the ends of the limbs).
_SPREAD = {"pelvis": 0.007, "hip": 0.008, "knee": 0.007, "ankle": 0.010, "neck": 0.006, "head": 0.006, "toe": 0.010}
_SPREAD |= {"shoulder": 0.006, "elbow": 0.008, "wrist": 0.011}
_SPREAD_OF = {name: _SPREAD[name.lstrip("lr") if name[1:] in _SPREAD else name] for name in BODY_17.joints}
#: Correlation of the noise of one image with that of the previous one.
_CORRELATION = 0.6
#: Radius of a limb that occludes.
_LIMB_RADIUS_M = 0.07
#: Images per step of the occlusion, for the memory's sake.
_CHUNK = 4096


class NoisyKeypoints(NamedTuple):
    """Keypoints (F, P, 2) px, confidence (F, P), covariance (F, P, 3) px^2, and (F, P) bool of what was simulated.

    visible : inside the image, found or not
    """

    keypoints: np.ndarray
    confidence: np.ndarray
    covariance: np.ndarray
    occluded: np.ndarray
    outlier: np.ndarray
    visible: np.ndarray


def detect_person(
    joints: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
    camera_matrix: np.ndarray,
    image_size: tuple[int, int],
    seed: int,
    **errors: float,
) -> NoisyKeypoints:
    """Keypoints of joints (F, P, 3) m ENU in a camera, with self-occlusion; NaN outside the image.

    rotation, position : (F, 3, 3) world -> camera, (F, 3) m ENU
    errors : keywords of :func:`noisy_keypoints`
    """
    exact = project(joints, rotation, position, camera_matrix)
    inside = np.all((exact >= -0.5) & (exact < np.array(image_size) - 0.5), axis=-1)
    occluded = occlusion(exact, to_camera(joints, rotation, position)[..., 2], camera_matrix[0, 0])
    return noisy_keypoints(np.where(inside[..., None], exact, np.nan), occluded, seed, **errors)


def occlusion(px: np.ndarray, depth: np.ndarray, focal_px: float) -> np.ndarray:
    """(F, P) bool, joints behind another limb or the trunk.

    px (F, P, 2), depth (F, P) m.  Limbs are capsules of 7 cm radius, the trunk of 14 cm.
    """
    hidden = np.zeros(depth.shape, dtype=bool)
    parent, child = BODY_15.bones.T
    radius = np.where((parent == 0) & (child == BODY_15.index("neck")), 2 * _LIMB_RADIUS_M, _LIMB_RADIUS_M)
    joint = np.arange(px.shape[1])[:, None]
    own = (joint == parent) | (joint == child)
    for start in range(0, len(px), _CHUNK):
        part = slice(start, start + _CHUNK)
        a, b = px[part, None, parent], px[part, None, child]
        axis = b - a
        along = np.sum((px[part, :, None] - a) * axis, axis=-1) / np.maximum(np.sum(axis**2, axis=-1), 1e-9)
        along = np.clip(along, 0.0, 1.0)
        gap = np.linalg.norm(px[part, :, None] - a - along[..., None] * axis, axis=-1)
        limb_depth = depth[part, None, parent] * (1 - along) + depth[part, None, child] * along
        covered = (gap * limb_depth < radius * focal_px) & (limb_depth < depth[part, :, None] - radius) & ~own
        hidden[part] = covered.any(axis=2)
    return hidden


def noisy_keypoints(
    px: np.ndarray,
    occluded: np.ndarray | None = None,
    seed: int = 0,
    *,
    noise_scale: float = 1.0,
    outlier_fraction: float = 0.03,
    missed_fraction: float = 0.015,
) -> NoisyKeypoints:
    """Exact keypoints with the errors of a detector.

    Noise is proportional to the height of the person's box, larger for wrists, ankles and occluded joints, and
    correlated over time; outliers and misses are three times as frequent among occluded joints.  The reported
    covariance is right on average, not per keypoint; most outliers have a lower confidence.

    px : (F, P, 2) exact projections, NaN outside the image
    occluded : (F, P) bool, see :func:`occlusion`
    """
    hidden = np.zeros(px.shape[:2], bool) if occluded is None else occluded
    height, count = _box_height(px[:, : len(BODY_15)]), len(BODY_15)
    # The toes have draws of their own: those of the other joints are the same with and without them.
    rates = (noise_scale, outlier_fraction, missed_fraction)
    parts = [
        _noisy(px[:, part], hidden[:, part], height, BODY_17.joints[part], np.random.default_rng(key), rates)
        for part, key in ((slice(count), [seed, 0x0B5]), (slice(count, px.shape[1]), [seed, 0x0B5, count]))
        if part.start is None or px.shape[1] > count
    ]
    return NoisyKeypoints(*(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True)))


def _noisy(
    px: np.ndarray,
    hidden: np.ndarray,
    height: np.ndarray,
    names: tuple[str, ...],
    rng: np.random.Generator,
    rates: tuple[float, float, float],
) -> NoisyKeypoints:
    """Keypoints (F, P, 2) of the joints ``names`` with errors, in persons of ``height`` (F,) px.

    rates : noise_scale, outlier_fraction, missed_fraction of :func:`noisy_keypoints`
    """
    from scipy.signal import lfilter

    noise_scale, outlier_fraction, missed_fraction = rates
    frames, joints = px.shape[:2]
    # Factor on the noise of occluded joints, which detectors guess.
    sigma = height[:, None] * np.array([_SPREAD_OF[name] for name in names]) * np.where(hidden, 2.2, 1.0)
    white = rng.standard_normal((frames, joints, 2))
    white[1:] *= np.sqrt(1 - _CORRELATION**2)
    noise = lfilter([1.0], [1.0, -_CORRELATION], white, axis=0) if frames > 1 else white
    keypoints = px + noise_scale * sigma[..., None] * noise

    rate = np.where(hidden, 3.0, 1.0)
    outlier = rng.random((frames, joints)) < outlier_fraction * rate
    angle = rng.uniform(0, 2 * np.pi, (frames, joints))
    length = rng.uniform(0.1, 0.4, (frames, joints)) * height[:, None]
    shift = length[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    keypoints = np.where(outlier[..., None], keypoints + shift, keypoints)
    missed = rng.random((frames, joints)) < missed_fraction * rate

    spread = np.maximum(noise_scale, 0.05) * sigma * np.where(outlier, 3.0, 1.0)
    variance = spread[..., None] ** 2 * np.exp(rng.normal(-0.03, 0.25, (frames, joints, 2)))
    mixed = 0.2 * rng.uniform(-1, 1, (frames, joints)) * np.sqrt(variance[..., 0] * variance[..., 1])
    covariance = np.stack([variance[..., 0], mixed, variance[..., 1]], axis=-1)

    inlier_confidence = rng.beta(14, 2.5, (frames, joints)) * np.where(hidden, 0.75, 1.0)
    confidence = np.where(outlier, rng.beta(3, 4.5, (frames, joints)), inlier_confidence)

    visible = np.isfinite(px).all(axis=-1)
    missed = missed | ~visible
    keypoints = np.where(missed[..., None], np.nan, keypoints)
    covariance = np.where(missed[..., None], np.nan, covariance)
    confidence = np.where(missed, 0.0, confidence)
    return NoisyKeypoints(keypoints, confidence, covariance, hidden, outlier & ~missed, visible)


def _box_height(px: np.ndarray) -> np.ndarray:
    """(F,) px; 0 for images without the person."""
    y = px[..., 1]
    top = np.min(np.where(np.isfinite(y), y, np.inf), axis=1)
    bottom = np.max(np.where(np.isfinite(y), y, -np.inf), axis=1)
    return np.where(np.isfinite(top) & np.isfinite(bottom), np.maximum(bottom - top, 1.0), 0.0)
