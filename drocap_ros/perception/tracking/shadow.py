"""Shadows on the ground: colours of the surroundings, darker."""

from __future__ import annotations

import numpy as np

#: Margin around the box that shows the ground, share of its sides; side of the patch, px.
_MARGIN, _PATCH = 0.3, 32
#: Brightness of a shadow over that of the ground, sRGB: sun and sky over sky alone; black clothes are darker.
_DARKEST, _BRIGHTEST = 0.3, 0.85
#: Largest difference between the channels' ratios in a shadow; skylight makes it bluer.
_TINT = 0.14
#: Least difference from the ground of what stands or lies on it, and least share of the box that differs.
_DIFFERENT, _LEAST = 0.15, 0.08
#: What a box full of shadow takes from the confidence of its pose, from half a box on.
_PENALTY, _HALF = 0.3, 0.5


def shadow_share(image: np.ndarray, box: np.ndarray) -> float:
    """Share of what is in a box and differs from the ground around it that is only darker, as a shadow.

    image : (H, W, 3) uint8 BGR; box : (4,) px x_min y_min x_max y_max
    """
    import cv2

    size = np.array([image.shape[1], image.shape[0]])
    extent = np.asarray(box[2:], float) - box[:2]
    low = np.clip(np.floor(box[:2] - _MARGIN * extent), 0, size).astype(int)
    high = np.clip(np.ceil(box[2:] + _MARGIN * extent), 0, size).astype(int)
    if (high - low).min() < 8:
        return 0.0
    view = image[low[1] : high[1], low[0] : high[0]]
    patch = cv2.resize(view, (_PATCH, _PATCH), interpolation=cv2.INTER_AREA).astype(np.float32)
    scale = _PATCH / (high - low)
    x0, y0, x1, y1 = np.round(((np.asarray(box, float).reshape(2, 2) - low) * scale).ravel()).astype(int)
    inside = np.zeros((_PATCH, _PATCH), bool)
    inside[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = True
    if inside.all() or not inside.any():
        return 0.0
    ground = np.median(patch[~inside], axis=0)
    ratio = patch[inside] / np.maximum(ground, 8.0)
    mean, spread = ratio.mean(axis=1), np.ptp(ratio, axis=1)
    different = (np.abs(ratio - 1.0) > _DIFFERENT).any(axis=1)
    if different.mean() < _LEAST:
        return 0.0
    shadow = (mean > _DARKEST) & (mean < _BRIGHTEST) & (spread < _TINT)
    return float((shadow & different).sum() / different.sum())


def without_shadow(confidence: float, image: np.ndarray, box: np.ndarray) -> float:
    """Confidence in a person of a pose of this mean confidence, found in a box (4,) px, less what its shadow takes."""
    return confidence - _PENALTY * max(0.0, shadow_share(image, box) - _HALF) / (1 - _HALF)
