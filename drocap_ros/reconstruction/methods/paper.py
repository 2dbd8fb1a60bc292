"""``--method paper`` and ``paper-no-articulation``: single-view initializer, then equations (2) to (4)."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.common.stop_reason import TOO_SHORT
from drocap_ros.reconstruction.common.windows import WindowResult, over_windows, placed
from drocap_ros.reconstruction.methods.initial import initial_poses
from drocap_ros.reconstruction.paper.bundle_adjustment import MIN_WINDOW, bundle_adjust
from drocap_ros.reconstruction.paper.normalize import NormalizedTracks


def run(data: MethodInput) -> CameraPoses:
    """Poses by the paper's method."""
    clock = time.perf_counter()
    joints, inlier = initial_poses(data)
    initialized = time.perf_counter()
    poses = _adjust(data, joints, inlier)
    return replace(poses, seconds={"initial": initialized - clock, "ba": time.perf_counter() - initialized})


def run_without_articulation(data: MethodInput) -> CameraPoses:
    """The ablation gamma = 0."""
    return run(replace(data, adjuster=replace(data.adjuster, gamma=0.0)))


def _adjust(data: MethodInput, joints: np.ndarray, inlier: np.ndarray) -> CameraPoses:
    """Bundle adjustment of poses (F, 15, 3) px over overlapping windows; ``inlier`` (F, 15) scales the information."""

    def solve(rows: slice, n: NormalizedTracks) -> WindowResult:
        initial = joints[rows] / n.scale_px
        if len(initial) < MIN_WINDOW:
            return WindowResult(placed(initial, n.w, n.information), {}, 0, TOO_SHORT)
        information = n.information * inlier[rows][..., None]
        result = bundle_adjust(n.w, information, initial, data.adjuster)
        poses = placed(result.camera_shape, n.w, information)
        return WindowResult(poses, result.cost_terms, result.iterations, result.stop_reason)

    return over_windows(data, solve)
