"""Output of a pose model for one person, before calibration."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Peaks(NamedTuple):
    """Joints in a model's output grid; P joints, K candidates.

    xy : (P, 2) float32, px of the model's input
    score : (P,) float32, height of the peak
    spread : (P, 3) float32 px^2, xx xy yy: second moments of the distribution around the peak, beyond the trained
        width of the peak
    candidates : (P, K, 3) float32, x y score of the highest peaks; the first is ``xy``, NaN where there are fewer
    """

    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    candidates: np.ndarray


class NetworkKeypoints(NamedTuple):
    """Keypoints of one person in image px; fields as in :class:`Peaks`.

    skeleton : name of the joint set
    box_size : px, longer side of the person's box, the unit of the calibration
    """

    skeleton: str
    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    candidates: np.ndarray
    box_size: float
