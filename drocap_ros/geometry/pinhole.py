"""The matrix of a camera whose axis meets the middle of its image."""

from __future__ import annotations

import numpy as np


def centred_camera(size: tuple[int, int], focal_px: float) -> np.ndarray:
    """Camera matrix (3, 3) px of images of ``size`` (width, height); pixel 0 has its centre at 0, as in OpenCV."""
    matrix = np.diag([focal_px, focal_px, 1.0])
    matrix[:2, 2] = (np.array(size) - 1) / 2
    return matrix
