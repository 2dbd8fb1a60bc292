"""Colours along a body's limbs: what tells two bodies apart where their boxes overlap."""

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
