"""Lenses that bend what they show, and points as they show them."""

from __future__ import annotations

import cv2
import numpy as np

#: Coefficients by the model of the distortion; a lens of an action camera has about these.
BENT = {
    "plumb_bob": [-0.2, 0.05, 0.001, -0.001, 0.0],
    "rational_polynomial": [-0.2, 0.05, 0.001, -0.001, 0.0, 0.1, 0.0, 0.0],
    "equidistant": [0.02, -0.01, 0.002, 0.0],
}


def bent(points: np.ndarray, matrix: np.ndarray, lens: str, times: float = 1.0) -> np.ndarray:
    """Points (..., 2) px of an ideal lens as one of ``BENT`` shows them, its coefficients so many times larger."""
    flat = np.asarray(points, float).reshape(-1, 2)
    rays = np.concatenate([(flat - matrix[:2, 2]) / np.diagonal(matrix)[:2], np.ones((len(flat), 1))], axis=1)
    project = cv2.fisheye.projectPoints if lens == "equidistant" else cv2.projectPoints
    shown = project(rays[:, None], np.zeros(3), np.zeros(3), np.asarray(matrix, float), times * np.array(BENT[lens]))[0]
    return shown[:, 0].reshape(np.shape(points))
