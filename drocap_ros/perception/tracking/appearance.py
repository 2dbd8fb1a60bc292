"""Appearance of a person: colour histograms of head, trunk and legs; colours along the limbs."""

from __future__ import annotations

import cv2
import numpy as np

from drocap_ros.skeleton import JointSet

_ALONG = (0.5, 0.7, 0.9)  # places on a limb, shares of its length
_WIDE = 0.012  # half the side of the patch at each, share of the body's length
#: Differences of L, a and b (of 255) that light and folds make on one person's limb.
_USUAL = np.array([40.0, 10.0, 10.0])


def limb_colours(image: np.ndarray, xy: np.ndarray, joints: JointSet, length: float) -> np.ndarray:
    """(P, 3) L a b of the limbs that end at joints (P, 2) px of an image (H, W, 3) BGR; NaN where there is none.

    length : px, of the body
    """
    parents = np.array(joints.parents)
    start = xy[np.maximum(parents, 0)]
    half = max(1, round(_WIDE * length))
    height, width = image.shape[:2]
    mean = np.full((len(_ALONG), len(xy), 3), np.nan)
    for n, share in enumerate(_ALONG):
        at = start + share * (xy - start)
        for j in np.flatnonzero((parents >= 0) & np.isfinite(at).all(axis=1)):
            x, y = (round(float(value)) for value in at[j])
            if half <= x < width - half and half <= y < height - half:
                mean[n, j] = image[y - half : y + half + 1, x - half : x + half + 1].mean(axis=(0, 1))
    known = np.isfinite(mean).all(axis=(0, 2))
    found = np.full((len(xy), 3), np.nan)
    if known.any():
        colour = np.round(mean[:, known].mean(axis=0)).astype(np.uint8)[None]
        found[known] = cv2.cvtColor(colour, cv2.COLOR_BGR2LAB)[0]
    return found


def difference(seen: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(..., P) deviations by which colours (..., P, 3) differ from a body's own (P, 3); NaN where one is unknown."""
    return np.asarray(np.linalg.norm((seen - known) / _USUAL, axis=-1))


#: Head, trunk and legs as shares of the box's height.
_PARTS = ((0.03, 0.17), (0.2, 0.5), (0.55, 0.9))
_WIDTH = 0.5  # middle share of the box's width, which holds little background
_BINS = 8  # of each histogram
_PATCH_PX = 12  # side of a part, independent of the person's


def describe(image: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Colour descriptor of the person in a box.

    image : (H, W, 3) uint8 BGR
    box : (4,) x_min y_min x_max y_max px

    Returns
    -------
    (72,) float32, square roots of the normalized Lab histograms of the three parts; None when the box holds too few
    pixels.
    """
    import cv2

    x0, y0, x1, y1 = (float(v) for v in box)
    width, height = x1 - x0, y1 - y0
    if width < 4 or height < 8:
        return None
    left, right = x0 + width * (1 - _WIDTH) / 2, x1 - width * (1 - _WIDTH) / 2
    histograms = []
    for top, bottom in _PARTS:
        rows = slice(max(0, int(y0 + top * height)), max(0, int(y0 + bottom * height) + 1))
        columns = slice(max(0, int(left)), max(0, int(right) + 1))
        view = image[rows, columns]
        if 0 in view.shape:
            return None
        lab = cv2.cvtColor(cv2.resize(view, (_PATCH_PX, _PATCH_PX), interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2LAB)
        # Colours of clothes and skin lie within a quarter of the range of a and b.
        ranges = ((0, 255), (96, 160), (96, 160))
        histograms += [_soft_histogram(lab[..., c].ravel(), *between) for c, between in enumerate(ranges)]
    roots: np.ndarray = np.sqrt(np.concatenate(histograms) / len(histograms)).astype(np.float32)
    return roots


def _soft_histogram(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """(_BINS,) shares; linear split between the two nearest bins, against jumps under small changes of light."""
    at = np.clip((values.astype(np.float64) - low) / (high - low), 0, 1) * (_BINS - 1)
    lower = np.minimum(at.astype(int), _BINS - 2)
    upper_share = at - lower
    total = np.bincount(lower, 1 - upper_share, _BINS) + np.bincount(lower + 1, upper_share, _BINS)
    return total / len(values)
