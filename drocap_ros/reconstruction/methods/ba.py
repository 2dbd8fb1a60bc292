"""``--method ba``, the default: :mod:`drocap_ros.reconstruction.lifted.method`, window by window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.common.windows import WindowResult, over_windows
from drocap_ros.reconstruction.lifted.lifted_config import lifted_config
from drocap_ros.reconstruction.lifted.method import solve_window
from drocap_ros.reconstruction.paper.normalize import NormalizedTracks


def run(data: MethodInput) -> CameraPoses:
    """Poses by the default method."""
    config = lifted_config(data.adjuster)
    seconds = {"initial": 0.0, "ba": 0.0}

    def solve(rows: slice, n: NormalizedTracks) -> WindowResult:
        covariance = data.keypoints.covariance
        covariance = None if covariance is None else covariance[rows] / n.scale_px**2
        rotation = None if data.rotation is None else data.rotation[rows]
        points = np.where((n.weights > 0.0)[..., None], n.w, np.nan)
        focal = None if data.focal_px is None else data.focal_px / n.scale_px
        seen = Keypoints2D(points, n.weights, covariance)
        found = solve_window(data.stamp_ns[rows], seen, focal, config, rotation=rotation)
        for stage, value in found.seconds.items():
            seconds[stage] += value
        return WindowResult(found.joints, found.cost_terms, found.steps[1], found.stop_reason, found.sigma, found.still)

    return replace(over_windows(data, solve), seconds=seconds)
