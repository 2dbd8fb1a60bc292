"""A simulated orbit as the live nodes receive it: observations, and the camera's reported poses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drocap_ros.background import Background
from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.geometry.rotations import quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.skeleton import BODY_17
from lab.simulation.capture import SimulationConfig, simulate_capture
from lab.studies.world_scene import PinholePath, followed_points

FPS = 15.0


@dataclass(frozen=True)
class Orbit:
    """observations : one per image; truth : (F, 17, 3) m ENU; the reported camera is exact.

    rotation : (F, 3, 3) world -> camera; position : (F, 3) m; matrix : (3, 3) px
    """

    observations: list[PoseObservation]
    truth: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    matrix: np.ndarray

    @property
    def stamp_ns(self) -> np.ndarray:
        return np.array([o.stamp_ns for o in self.observations], np.int64)

    @cached_property
    def background(self) -> Background:
        """The scene's fixed points."""
        size = self.observations[0].image_size
        path = PinholePath(self.position, self.rotation, float(self.matrix[0, 0]), size)
        return followed_points(path, self.truth, FPS, 0)

    def points_at(self, stamp_ns: np.ndarray) -> Background:
        """Those in the images of stamps (F,)."""
        return self.background.of_frames(np.searchsorted(self.stamp_ns, stamp_ns))

    def history(self, frames: slice = slice(None), keep_s: float = 12.0) -> CameraHistory:
        """The poses of some images and the calibration, as they arrive."""
        history = CameraHistory(keep_s)
        history.add_matrix(int(self.stamp_ns[0]), self.matrix)
        orientation = quaternion_from_matrix(np.swapaxes(self.rotation, 1, 2))
        for stamp, position, turn in zip(
            self.stamp_ns[frames].tolist(), self.position[frames], orientation[frames], strict=True
        ):
            history.add_pose(stamp, position, turn)
        return history


def orbit(
    seconds: float,
    seed: int = 0,
    begin_ns: int = 0,
    track_id: int = 1,
    action: str = "walk",
    speed_deg_s: float = 25.0,
) -> Orbit:
    """A person of the assumed stature, filmed from 6 m."""
    config = SimulationConfig(
        action=action,
        stature_m=1.70,
        attitude_error_deg=0.0,
        position_error_m=0.0,
        outlier_fraction=0.01,
        angular_speed_deg_s=speed_deg_s,
    )
    capture = simulate_capture(seconds, FPS, seed, config, begin_ns, BODY_17)
    t = capture.tracks
    assert t.confidence is not None
    assert t.covariance is not None
    observations = [
        PoseObservation(
            int(stamp),
            track_id,
            t.image_size,
            joints=BODY_17,
            keypoints=t.keypoints[i].astype(np.float32),
            covariance=t.covariance[i].astype(np.float32),
            confidence=t.confidence[i].astype(np.float32),
        )
        for i, stamp in enumerate(t.stamp_ns)
    ]
    return Orbit(
        observations, capture.joints3d_world, capture.camera_rotation, capture.camera_position, t.camera_matrix
    )
