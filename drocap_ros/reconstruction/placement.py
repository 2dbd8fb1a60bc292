"""Scale and place of the reconstructed body: from px to metres, from the camera to the world."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.dictionary import LIMBS_PER_STATURE
from drocap_ros.reconstruction.metrics import limb_lengths
from drocap_ros.tracks import Tracks

#: Time over which the person's image size is averaged: a drone changes its range slowly.
SIZE_SMOOTHING_S = 1.0


def metres_per_px(joints_px: np.ndarray, stamp_ns: np.ndarray, height_m: float) -> np.ndarray:
    """(F,) metres per px that give the body of poses (F, 15, 3) px the limb lengths of a person of ``height_m``."""
    total = limb_lengths(joints_px).sum(-1)
    return height_m * LIMBS_PER_STATURE / np.maximum(smooth_over_time(total, stamp_ns, SIZE_SMOOTHING_S), 1e-9)


def smooth_over_time(values: np.ndarray, stamp_ns: np.ndarray, std_s: float) -> np.ndarray:
    """Gaussian average (F, ...) over a standard deviation in time; shorter than a sample changes nothing."""
    from scipy.ndimage import gaussian_filter1d

    if len(values) < 2:
        return values
    step_s = float(np.median(np.diff(stamp_ns))) * 1e-9
    return gaussian_filter1d(values, std_s / step_s, axis=0, mode="nearest", truncate=3.0)


def place_in_world(joints: np.ndarray, pelvis_px: np.ndarray, per_px: np.ndarray, tracks: Tracks) -> np.ndarray:
    """Poses (F, 15, 3) m in camera axes, pelvis at the origin, turned and moved to the world (ENU, z up).

    The pelvis lies on its pixel's ray at the weak-perspective range, focal length times metres per px; without
    the camera's position and matrix it stays at the origin.
    """
    to_world = tracks.camera_rotation
    assert to_world is not None
    turned = joints @ to_world
    if tracks.camera_position is None or tracks.camera_matrix is None:
        return turned
    k = tracks.camera_matrix
    depth = 0.5 * (k[0, 0] + k[1, 1]) * per_px
    ray = np.stack(
        [(pelvis_px[:, 0] - k[0, 2]) / k[0, 0], (pelvis_px[:, 1] - k[1, 2]) / k[1, 1], np.ones(len(depth))], axis=-1
    )
    pelvis = tracks.camera_position + (ray[:, None] * depth[:, None, None] @ to_world)[:, 0]
    return turned + pelvis[:, None]
