"""Input features of the lifter: 2D joints without position and size; the same for training and inference."""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import nanmedian_small
from drocap_ros.skeleton import BODY_17, indices

#: Bones whose lengths are input features: that of joint j to its parent stands at j - 1.
BONES = BODY_17.bones

_JOINTS = len(BODY_17)
#: Widths of the parts of a frame's features: x and y, confidence, bones' lengths, their reaches in depth, standard
#: deviations of x and y, their correlation, turn of the camera, direction of gravity, whether both are known,
#: size over distance, whether the lens is known.
PARTS = (2 * _JOINTS, _JOINTS, len(BONES), len(BONES), 2 * _JOINTS, _JOINTS, 3, 3, 1, 1, 1)
#: Input features of a frame.
FEATURES = sum(PARTS)

_TORSO = indices(BODY_17.joints, ("pelvis", "rhip", "lhip", "neck", "lshoulder", "rshoulder"))
#: Limit of the features of places, in sizes of the person, as in the training.
_CLIP = 6.0
#: Factor of the training that brings standard deviations (share of the size) to the order of one.
_STD_FACTOR = 10.0


def centre_of(keypoints: np.ndarray) -> np.ndarray:
    """(..., F, 2) median of the seen torso joints of (..., F, 17, 2); gaps in time are filled from neighbours."""
    centre = nanmedian_small(keypoints[..., _TORSO, :], axis=-2)
    missing = ~np.isfinite(centre[..., 0])
    if missing.any():
        centre[missing] = nanmedian_small(keypoints[missing], axis=-2)
        _fill_gaps(centre)
    return centre


def _fill_gaps(centre: np.ndarray) -> None:
    flat = centre.reshape(-1, *centre.shape[-2:])
    frames = np.arange(flat.shape[1])
    for k in np.flatnonzero(~np.isfinite(flat[..., 0]).all(axis=-1)):
        seen = np.isfinite(flat[k, :, 0])
        for axis in range(2):
            flat[k, :, axis] = np.interp(frames, frames[seen], flat[k, seen, axis]) if seen.any() else 0.0
    centre[...] = flat.reshape(centre.shape)


def scale_of(centred: np.ndarray) -> np.ndarray:
    """(...) size of (..., F, 17, 2) centred joints: median over frames of the mean distance from the centre."""
    distance = np.sqrt(np.square(centred).sum(axis=-1))
    seen = np.isfinite(distance)
    count = seen.sum(axis=-1)
    mean = np.where(seen, distance, 0).sum(axis=-1) / np.maximum(count, 1)
    size = nanmedian_small(np.where(count > 0, mean, np.nan), axis=-1)
    return np.where(np.isfinite(size) & (size > 0), size, 1.0)


def normalise(
    keypoints: np.ndarray,
    confidence: np.ndarray,
    lengths: np.ndarray | None = None,
    covariance: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
    focal: np.ndarray | float | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of windows of 2D joints.

    keypoints : (..., F, 17, 2), any unit, y down; NaN where not seen
    confidence : (..., F, 17) in [0, 1]
    lengths : (..., 16) of the bones in the unit of the keypoints, NaN where unknown; None = unknown
    covariance : (..., F, 17, 3) xx, xy, yy of the keypoints in their unit squared, NaN where unknown; None = unknown
    rotation : (..., F, 3, 3) world (z up) -> camera (x right, y down, z forward), NaN where unknown; None = unknown
    focal : (...) focal length in the keypoints' unit, infinite for a distant camera, NaN where unknown; None = unknown

    Returns
    -------
    features : (..., F, 143) float32, 0 where unknown; their order is that of :data:`PARTS`
    centre : (..., F, 2) of every frame
    scale : (...) one for the window
    """
    centre = centre_of(keypoints)
    centred = keypoints - centre[..., None, :]
    scale = scale_of(centred)
    seen = np.isfinite(centred[..., 0])
    xy = np.clip(np.where(seen[..., None], centred, 0) / scale[..., None, None, None], -_CLIP, _CLIP)
    weight = np.where(seen, confidence, 0)
    features = [
        xy.reshape(*xy.shape[:-2], -1),
        weight,
        *_bone_features(xy, seen, scale, lengths),
        *_error_features(seen, scale, covariance),
        *_camera_features(seen.shape[:-1], rotation),
        *_lens_features(seen.shape[:-1], scale, focal),
    ]
    return np.concatenate(features, axis=-1, dtype=np.float32), centre, scale


def _bone_features(
    xy: np.ndarray, seen: np.ndarray, scale: np.ndarray, lengths: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    shape = (*seen.shape[:-1], len(BONES))
    if lengths is None:
        return np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    length = np.nan_to_num(lengths / scale[..., None])[..., None, :]
    flat = np.square(xy[..., BONES[:, 1], :] - xy[..., BONES[:, 0], :]).sum(axis=-1)
    both = seen[..., BONES[:, 1]] & seen[..., BONES[:, 0]] & (length > 0)
    reach = np.sqrt(np.where(both, np.maximum(np.square(length) - flat, 0), 0))
    return np.broadcast_to(length, shape), reach


def _error_features(
    seen: np.ndarray, scale: np.ndarray, covariance: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    if covariance is None:
        return np.zeros((*seen.shape[:-1], 2 * _JOINTS), np.float32), np.zeros(seen.shape, np.float32)
    known = np.where(seen[..., None], np.nan_to_num(covariance), 0.0)
    std = np.sqrt(np.maximum(known[..., [0, 2]], 0.0))
    correlation = known[..., 1] / np.maximum(std[..., 0] * std[..., 1], 1e-12)
    size = np.minimum(_STD_FACTOR * std / scale[..., None, None, None], _CLIP)
    return size.reshape(*seen.shape[:-1], -1), np.clip(correlation, -1.0, 1.0)


def _camera_features(shape: tuple[int, ...], rotation: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turn of the camera since the frame before as a rotation vector, gravity in camera axes, 1 where known."""
    if rotation is None:
        return np.zeros((*shape, 3), np.float32), np.zeros((*shape, 3), np.float32), np.zeros((*shape, 1), np.float32)
    known = np.isfinite(rotation).all(axis=(-2, -1))
    usual = np.where(known[..., None, None], rotation, np.eye(3))
    step = usual[..., 1:, :, :] @ np.swapaxes(usual[..., :-1, :, :], -1, -2)
    # The turn of a frame is small: the skew part is the rotation vector.
    skew = step - np.swapaxes(step, -1, -2)
    turn = np.zeros((*shape, 3))
    # The factor 20 of the training brings turns (rad per frame) to the order of one.
    turn[..., 1:, :] = 0.5 * 20.0 * np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    turn[..., 1:, :] *= (known[..., 1:] & known[..., :-1])[..., None]
    return turn, -usual[..., :, 2] * known[..., None], known[..., None]


def _lens_features(
    shape: tuple[int, ...], scale: np.ndarray, focal: np.ndarray | float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Size of the person over the focal length, and 1 where the latter is known."""
    if focal is None:
        return np.zeros((*shape, 1), np.float32), np.zeros((*shape, 1), np.float32)
    width = np.broadcast_to(np.asarray(scale / focal), scale.shape)[..., None, None]
    known = np.isfinite(width)
    full = (*shape, 1)
    return np.broadcast_to(np.where(known, _STD_FACTOR * width, 0.0), full), np.broadcast_to(known, full)


def mirrored(features: np.ndarray) -> np.ndarray:
    """Features (..., 143) of the scene seen in a mirror: x negated, left and right exchanged."""
    xy, weight, length, reach, std, correlation, turn, gravity, *rest = np.split(
        features, np.cumsum(PARTS)[:-1], axis=-1
    )
    shape = (*features.shape[:-1], _JOINTS, 2)
    joints, bones = BODY_17.mirror, BODY_17.mirror[1:] - 1
    flip = np.array([-1, 1], np.float32)
    return np.concatenate(
        [
            (xy.reshape(shape)[..., joints, :] * flip).reshape(xy.shape),
            weight[..., joints],
            length[..., bones],
            reach[..., bones],
            std.reshape(shape)[..., joints, :].reshape(std.shape),
            -correlation[..., joints],
            turn * np.array([1, -1, -1], np.float32),
            gravity * np.array([-1, 1, 1], np.float32),
            *rest,
        ],
        axis=-1,
    )
