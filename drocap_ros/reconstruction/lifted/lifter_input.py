"""Input features of the lifter: 2D joints without position and size; the same for training and inference."""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, indices

#: Frame rate of the network; other rates are resampled.
LIFTER_FPS = 24.0
#: Bones whose lengths are input features: that of joint j to its parent stands at j - 1.
BONES = BODY_15.bones
#: Input features of a frame: x, y and confidence of every joint, length and depth range of every bone.
FEATURES = 3 * len(BODY_15) + 2 * len(BONES)

_TORSO = indices(BODY_15.joints, ("pelvis", "rhip", "lhip", "neck", "lshoulder", "rshoulder"))
_CLIP = 6.0


def nanmedian_small(values: np.ndarray, axis: int) -> np.ndarray:
    """Median that ignores NaN along a short axis; NaN where everything is (no warning, unlike numpy's)."""
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(values).sum(axis=axis, keepdims=True)
    low = np.take_along_axis(ordered, np.maximum(count - 1, 0) // 2, axis=axis)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[axis] - 1), axis=axis)
    return np.squeeze(0.5 * (low + high), axis=axis)


def centre_of(keypoints: np.ndarray) -> np.ndarray:
    """(..., F, 2) median of the seen torso joints of (..., F, 15, 2); gaps in time are filled from neighbours."""
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
    """(...) size of (..., F, 15, 2) centred joints: median over frames of the mean distance from the centre."""
    distance = np.sqrt(np.square(centred).sum(axis=-1))
    seen = np.isfinite(distance)
    count = seen.sum(axis=-1)
    mean = np.where(seen, distance, 0).sum(axis=-1) / np.maximum(count, 1)
    size = nanmedian_small(np.where(count > 0, mean, np.nan), axis=-1)
    return np.where(np.isfinite(size) & (size > 0), size, 1.0)


def normalise(
    keypoints: np.ndarray, confidence: np.ndarray, lengths: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features of windows of 2D joints.

    Parameters
    ----------
    keypoints : (..., F, 15, 2), any unit, y down; NaN where not seen
    confidence : (..., F, 15) in [0, 1]
    lengths : (..., 14) of the bones in the unit of the keypoints, NaN where unknown; None = unknown

    Returns
    -------
    features : (..., F, 73) float32: x, y of every joint (0 where not seen), its confidence, then the length of
        every bone and its reach in depth at that length (0 where unknown)
    centre : (..., F, 2) of every frame
    scale : (...) one for the window
    """
    centre = centre_of(keypoints)
    centred = keypoints - centre[..., None, :]
    scale = scale_of(centred)
    seen = np.isfinite(centred[..., 0])
    xy = np.clip(np.where(seen[..., None], centred, 0) / scale[..., None, None, None], -_CLIP, _CLIP)
    weight = np.where(seen, confidence, 0)
    features = [xy.reshape(*xy.shape[:-2], -1), weight, *_bone_features(xy, seen, scale, lengths)]
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
