"""Camera positions for drawing, from the body and its keypoints where no telemetry measured them."""

from __future__ import annotations

import numpy as np

#: Horizontal field of view where the calibration is unknown: a typical drone camera.
NOMINAL_FOV_DEG = 70.0


def nominal_camera_matrix(width: float, height: float) -> np.ndarray:
    """(3, 3) px of an image of unknown calibration."""
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * NOMINAL_FOV_DEG))
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def place_cameras(
    joints: np.ndarray, keypoints: np.ndarray, rotation: np.ndarray, camera_matrix: np.ndarray
) -> np.ndarray:
    """Camera positions (F, 3) m from which bodies project to the size and place of their keypoints.

    Scaled orthographic projection, so exact only for a far camera; NaN where fewer than two joints are seen.

    Parameters
    ----------
    joints : (F, P, 3) m in the world, NaN unknown
    keypoints : (F, P, 2) px, NaN not seen
    rotation : (F, 3, 3) world -> optical
    camera_matrix : (3, 3) px
    """
    seen = (np.isfinite(joints).all(-1) & np.isfinite(keypoints).all(-1))[..., None]
    count = seen.sum(1, keepdims=True)
    enough = count[:, 0, 0] >= 2
    axes = np.where(seen, np.einsum("fij,fpj->fpi", rotation, np.nan_to_num(joints)), 0.0)
    image = np.where(seen, np.nan_to_num(keypoints), 0.0)
    middle = axes.sum(1, keepdims=True) / np.maximum(count, 1)
    place = image.sum(1, keepdims=True) / np.maximum(count, 1)
    spread_m = np.sqrt((((axes - middle)[..., :2] * seen) ** 2).sum((1, 2)))
    spread_px = np.sqrt((((image - place) * seen) ** 2).sum((1, 2)))
    focal = 0.5 * (camera_matrix[0, 0] + camera_matrix[1, 1])
    enough &= (spread_px > 1e-6) & (spread_m > 1e-6)
    range_m = focal * spread_m / np.where(enough, spread_px, 1.0)
    lateral = (place[:, 0] - camera_matrix[:2, 2]) * (range_m / focal)[:, None]
    body = np.concatenate([lateral, range_m[:, None]], 1)  # the body's centre in optical axes
    position = np.einsum("fji,fj->fi", rotation, middle[:, 0] - body)
    return np.where(enough[:, None], position, np.nan)
