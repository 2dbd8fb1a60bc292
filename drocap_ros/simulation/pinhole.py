"""The pinhole camera of the simulated drone."""

from __future__ import annotations

import numpy as np


def pinhole_matrix(image_width: int, image_height: int, horizontal_fov_deg: float) -> np.ndarray:
    """(3, 3) px, square pixels, principal point in the middle (pixel centres at whole numbers)."""
    focal = 0.5 * image_width / np.tan(0.5 * np.deg2rad(horizontal_fov_deg))
    return np.array([[focal, 0.0, 0.5 * (image_width - 1)], [0.0, focal, 0.5 * (image_height - 1)], [0.0, 0.0, 1.0]])


def to_camera(points: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(F, P, 3) m in the camera frame of world points (F, P, 3)."""
    return np.asarray(np.einsum("fij,fpj->fpi", rotation, points - position[:, None, :]))


def project(points: np.ndarray, rotation: np.ndarray, position: np.ndarray, camera_matrix: np.ndarray) -> np.ndarray:
    """(F, P, 2) px of world points (F, P, 3); NaN for points not in front of the camera."""
    local = to_camera(points, rotation, position)
    depth = local[..., 2]
    safe = np.where(depth > 1e-3, depth, np.nan)
    pixel = np.einsum("ij,fpj->fpi", camera_matrix, local)
    return np.asarray(pixel[..., :2] / safe[..., None])
