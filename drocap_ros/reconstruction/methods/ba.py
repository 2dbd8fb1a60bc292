"""``--method ba``, the default: :mod:`drocap_ros.reconstruction.lifted.method`, window by window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput, Report
from drocap_ros.reconstruction.common.windows import over_windows
from drocap_ros.reconstruction.lifted.lifted_config import lifted_config
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.method import solve_window


def run(data: MethodInput) -> ImagePoses:
    """Poses by the default method."""
    config = lifted_config(data.adjuster, drawn_toes=data.pictures)
    origin = {"parameters": {"default_method": config}, "lifter": Lifter.load(config.lifter or None).origin}

    def solve(rows: slice) -> ImagePoses:
        window = data.frames(rows)
        weights = window.keypoints.weights
        points = np.where((weights > 0.0)[..., None], window.keypoints.xy, np.nan)
        # The way of the body through the image is no noise of the keypoints.
        middle = np.nanmean(points, axis=1)
        seen = Keypoints2D(points - middle[:, None], weights, window.keypoints.covariance)
        found = solve_window(
            window.stamp_ns, seen, data.focal_px, config, rotation=window.rotation, evidence=window.evidence
        )
        joints = found.joints.copy()
        joints[..., :2] += middle[:, None]
        report = Report(found.steps[1], found.stop_reason, found.cost_terms, found.seconds, origin)
        poses = ImagePoses.uncentred(joints, report)
        return replace(poses, sigma_px=found.sigma, still=found.still, spread=found.spread)

    return over_windows(data, solve)
