"""Poses in the image to poses in the world: placed by the reported camera, then adjusted together with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.interpolation import without_steps
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.world.placement import WorldPoses, place_in_world
from drocap_ros.reconstruction.world.refine import Before, RefinedWorld, refinable, refine_in_world
from drocap_ros.reconstruction.world.telemetry_checks import upside_down
from drocap_ros.reconstruction.world.world_model import Findings, PlacedPoses, WorldConfig
from drocap_ros.skeleton import BODY_15

_PELVIS = BODY_15.index("pelvis")


def in_camera_axes(poses: ImagePoses, per_px: np.ndarray) -> np.ndarray:
    """(F, P, 3) m in the camera's axes, pelvis at the origin, at (F,) metres per px."""
    joints: np.ndarray = (poses.joints_px - poses.joints_px[:, _PELVIS][:, None]) * per_px[:, None, None]
    return joints


def in_world(
    camera: CameraPath,
    keypoints: Keypoints2D,
    poses: ImagePoses,
    per_px: np.ndarray,
    config: WorldConfig | None,
    known: Findings | None = None,
    before: Before | None = None,
) -> tuple[WorldPoses, RefinedWorld | Refusal | None]:
    """Poses placed by the camera's rotation and, with its position and matrix, adjusted with it, or why not.

    keypoints : of the method's joints
    per_px : (F,) metres per px at the assumed stature
    config : of the adjustment; None = the poses are placed alone
    known, before : findings of earlier windows, and the last of them
    """
    rotation = camera.rotation
    assert rotation is not None
    projected, sigma = poses.in_image[..., :2], poses.sigma_px
    whole = sigma is not None and config is not None and refinable(camera)
    if camera.position is not None and whole:
        camera = replace(camera, position=without_steps(camera.position, camera.stamp_ns))
    placed = place_in_world(in_camera_axes(poses, per_px), projected, per_px, camera)
    refusal = upside_down(placed.joints, rotation) if sigma is not None and config and config.checks else None
    if refusal or sigma is None or config is None or not whole or not np.isfinite(placed.joints).all():
        return placed, refusal
    size = per_px[:, None]
    depth = (poses.joints_px[..., 2] - poses.joints_px[:, [_PELVIS], 2]) * size
    given = PlacedPoses(
        placed.joints, placed.factor, depth, sigma[..., 1] * size, projected, sigma[..., 0], poses.still
    )
    return placed, refine_in_world(camera, keypoints, given, config, known, before)
