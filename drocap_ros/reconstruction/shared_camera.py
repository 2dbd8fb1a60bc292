"""The camera of several persons in the same images: found with one of them, held for the others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.contacts import ANKLES
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.camera.fusion import with_camera_errors
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import WorldConfig
from drocap_ros.tracks import Tracks

#: Errors that the adjustments of the others may still give to the camera: a tenth of those that fixed points leave.
_HELD_DEG = 0.005
_HELD_M = 0.002
_HELD_S = 1e-4
#: Standard deviation of the logarithm of a stature: adults' 0.05, and children are among others.
_STATURE_STD = 0.1
#: The same of a stature by the ground: the lifter's sizes, as for a path's metres.
_GROUND_STD = 0.04
#: Slope (degrees) of ground that looks level.
_SLOPE_DEG = 2.0
#: Height (m) of the camera above the ground below which a ray does not tell where it meets the ground.
_LOW_M = 0.5


@dataclass(frozen=True)
class SharedCamera:
    """The camera of F images in the world, as the adjustment with one person left it.

    stamp_ns : (F,); rotation : (F, 3, 3) world -> camera; position : (F, 3) m; matrix : (3, 3) px
    lens : where the matrix comes from
    config : of the adjustments of others; None = up is unsure, and bodies stay as they are seen
    metric, scale_source : of its metres
    feet : (F, 3) m, the lower ankle of that person; up_std_deg : standard deviation of up
    covariance : (F, 6, 6) of position (m) and rotation (rad, camera axes); None = its errors are in the joints' own
    words : ``meta["camera"]`` of that person, None = telemetry told the camera
    """

    stamp_ns: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    matrix: np.ndarray
    lens: str
    config: WorldConfig | None
    metric: bool
    scale_source: str
    feet: np.ndarray
    up_std_deg: float
    covariance: np.ndarray | None = None
    words: dict[str, object] | None = None

    def of_images(self, stamp_ns: np.ndarray) -> SharedCamera:
        """In a choice of the images, by their stamps."""
        rows = np.searchsorted(self.stamp_ns, stamp_ns)
        arrays = {name: getattr(self, name)[rows] for name in ("stamp_ns", "rotation", "position", "feet")}
        covariance = None if self.covariance is None else self.covariance[rows]
        return replace(self, covariance=covariance, **arrays)

    def given_to(self, tracks: Tracks) -> Tracks:
        """Tracks of the same images with this camera; it has used their fixed points."""
        return replace(
            tracks,
            camera_rotation=self.rotation,
            camera_position=self.position,
            camera_matrix=self.matrix,
            background=None,
        )

    def stature(self, seen: np.ndarray) -> tuple[float, float]:
        """Factor on a person's assumed stature, and the standard deviation of its logarithm.

        A larger person is farther away: the feet stand on the ground on which those of the first person stand.

        seen : (F, P, 3) m from the camera, in its axes, at the assumed stature
        """
        below = seen[:, ANKLES] @ self.rotation
        lower = below[np.arange(len(below)), below[..., 2].argmin(axis=1)]
        height = self.position[:, 2] - float(np.median(self.feet[:, 2]))
        tells = (height > _LOW_M) & (lower[:, 2] < 0.0)
        if tells.mean() < 0.5:
            return 1.0, _STATURE_STD
        each = np.log(height[tells] / -lower[tells, 2])
        place = self.position + lower
        apart = np.linalg.norm((place - self.feet)[tells, :2], axis=1) / height[tells]
        tilt = np.deg2rad(np.hypot(self.up_std_deg, _SLOPE_DEG)) * float(np.median(apart))
        weights = np.array([1.0 / (_GROUND_STD**2 + tilt**2), 1.0 / _STATURE_STD**2])
        return float(np.exp(weights[0] * np.median(each) / weights.sum())), float(weights.sum() ** -0.5)

    def for_stature(self, std: float) -> SharedCamera:
        """For a person whose stature is known to a relative standard deviation."""
        return self if self.config is None else replace(self, config=replace(self.config, stature_std=std))

    def holds(self, refined: RefinedWorld) -> RefinedWorld:
        """An adjusted world with this very camera, and with its uncertainty in the joints'."""
        metric = refined.metric and self.metric
        refined = replace(refined, rotation=self.rotation, position=self.position, metric=metric)
        return refined if self.covariance is None else with_camera_errors(refined, self.covariance)


def lower_ankle(motion: Motion) -> np.ndarray:
    """(F, 3) m, the lower ankle of every frame."""
    ankles = motion.joints3d[:, ANKLES]
    found: np.ndarray = ankles[np.arange(len(ankles)), ankles[..., 2].argmin(axis=1)]
    return found


def held(config: WorldConfig) -> WorldConfig:
    """The parameters of an adjustment to which the camera is known."""
    return replace(
        config,
        tilt_error_deg=_HELD_DEG,
        yaw_error_deg=_HELD_DEG,
        latency_std_s=_HELD_S,
        position_wander_m=_HELD_M,
        attitude_wander_deg=_HELD_DEG,
        checks=False,
    )
