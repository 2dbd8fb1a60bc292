"""Keypoints of one person as a pose model gives them, before calibration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Peaks(NamedTuple):
    """Joints found in a model's output grid; P joints, K candidates.

    xy : (P, 2) float32, in px of the grid's input picture
    score : (P,) float32, height of the peak
    spread : (P, 3) float32 px^2, xx xy yy: second moments of the distribution around the peak, beyond the
        width that the model was trained to give to a certain joint
    candidates : (P, K, 3) float32, x y score of the highest peaks, the first being ``xy``; NaN where there are fewer
    """

    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    candidates: np.ndarray


class Keypoints(NamedTuple):
    """Keypoints of one person in image px; fields as in :class:`Peaks`.

    box_size : px, the longer side of the person's box, the unit of the calibration
    """

    skeleton: str
    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    candidates: np.ndarray
    box_size: float
