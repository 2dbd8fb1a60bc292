"""The camera of several persons in the same images: found with one of them, held for the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.camera_path import CameraErrors, CameraPath, Teller
from drocap_ros.contacts import ANKLES
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.world.refine import RefinedWorld

#: Errors that the adjustments of the others may still give to the camera: a tenth of those that fixed points leave.
_HELD = CameraErrors(0.005, 0.005, 1e-4, position_wander_m=0.002, attitude_wander_deg=0.005)
#: Standard deviation of the logarithm of a stature: adults' 0.05, and children are among others.
_STATURE_STD = 0.1
#: Height (m) of the camera above the ground below which a ray does not tell where it meets the ground.
_LOW_M = 0.5


def shared(motion: Motion, camera: CameraPath) -> CameraPath | None:
    """The camera that the others in the images can share; None where it has no place in a world, or no lens.

    camera : of the person's reconstruction, before the adjustment that gave ``motion``
    """
    if motion.frame != "world" or motion.camera_position is None or camera.matrix is None:
        return None
    by_picture = camera.teller is Teller.PICTURE
    covariance = None if by_picture else camera.covariance
    return replace(
        camera.moved(motion.camera_rotation, motion.camera_position),
        teller=Teller.PERSON,
        errors=_HELD,
        covariance=covariance,
        scale_std=None,
        metric=motion.metric,
        scale_source=motion.scale_source,
        corrected=False,
        points_tell_up=camera.upright and (by_picture or covariance is not None),
        measured=None,
        feet=_lower_ankle(motion.joints3d),
    )


def stature(camera: CameraPath, seen: np.ndarray) -> tuple[float, float]:
    """Factor on a person's assumed stature, and the standard deviation of its logarithm.

    A larger person is farther away: the feet stand on the ground on which those of the first person stand.

    seen : (F, P, 3) m from the camera, in its axes, at the assumed stature
    """
    rotation, position = camera.pose
    assert camera.feet is not None
    lower = _lower_ankle(seen @ rotation)
    height = position[:, 2] - float(np.median(camera.feet[:, 2]))
    tells = (height > _LOW_M) & (lower[:, 2] < 0.0)
    if tells.mean() < 0.5:
        return 1.0, _STATURE_STD
    each = np.log(height[tells] / -lower[tells, 2])
    apart = np.linalg.norm((position + lower - camera.feet)[tells, :2], axis=1) / height[tells]
    # Slope (degrees) of ground that looks level.
    tilt = np.deg2rad(np.hypot(camera.up_std_deg, 2.0)) * float(np.median(apart))
    # A stature by the ground has the deviation of the lifter's sizes, as a path's metres have.
    weights = np.array([1.0 / (0.04**2 + tilt**2), 1.0 / _STATURE_STD**2])
    return float(np.exp(weights[0] * np.median(each) / weights.sum())), float(weights.sum() ** -0.5)


def held(refined: RefinedWorld, camera: CameraPath) -> RefinedWorld:
    """An adjusted world with this very camera."""
    rotation, position = camera.pose
    return replace(refined, rotation=rotation, position=position, metric=refined.metric and camera.metric)


def _lower_ankle(joints: np.ndarray) -> np.ndarray:
    """(F, 3) m, the lower ankle of every frame."""
    ankles = joints[:, ANKLES]
    found: np.ndarray = ankles[np.arange(len(ankles)), ankles[..., 2].argmin(axis=1)]
    return found
