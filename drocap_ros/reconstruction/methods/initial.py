"""``--method initial``: the paper's single-view initializer, block by block."""

from __future__ import annotations

import time

import numpy as np

from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.common.stop_reason import NO_ADJUSTMENT
from drocap_ros.reconstruction.common.windows import normalized_windows, placed, split
from drocap_ros.reconstruction.paper.reprojection import information_from
from drocap_ros.reconstruction.paper.single_view import initialize


def run(data: MethodInput) -> CameraPoses:
    """Poses by the initializer alone."""
    clock = time.perf_counter()
    joints, inlier = initial_poses(data)
    seconds = {"initial": time.perf_counter() - clock, "ba": 0.0}
    keypoints = data.keypoints
    weights = inlier if keypoints.confidence is None else inlier * np.nan_to_num(keypoints.confidence)
    information = information_from(keypoints.xy, weights, keypoints.covariance)
    return CameraPoses(*split(placed(joints, keypoints.xy, information)), seconds, 0, NO_ADJUSTMENT, {})


def initial_poses(data: MethodInput) -> tuple[np.ndarray, np.ndarray]:
    """Single-view initializer over blocks of frames.

    Returns
    -------
    poses (F, 15, 3) px in camera axes, centred
    inlier (F, 15) in [0, 1]: probability of the last E-step that the 2D joint is no outlier
    """
    keypoints, config = data.keypoints, data.initializer
    out = np.zeros((*keypoints.xy.shape[:2], 3))
    inlier = np.zeros(keypoints.xy.shape[:2])
    for rows, n in normalized_windows(keypoints, config.block_frames, 0):
        fit = initialize(n.w, n.information, data.dictionary, config)
        shape = fit.camera_shape
        before = n.information[..., 0] + n.information[..., 2]
        after = fit.information[..., 0] + fit.information[..., 2]
        inlier[rows] = after / np.where(before > 0.0, before, 1.0)
        out[rows] = (shape - shape.mean(axis=1, keepdims=True)) * n.scale_px
        data.progress("initial", rows.stop / len(keypoints))
    return out, inlier
