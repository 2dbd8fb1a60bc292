"""One recording of several of the same person: its own result, and what it shows at other instants."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.camera_path import CameraErrors, CameraPath
from drocap_ros.errors import InputError
from drocap_ros.geometry.interpolation import usual_step
from drocap_ros.geometry.rotations import project_to_so3
from drocap_ros.motion import LEVEL_CAMERA
from drocap_ros.reconstruction.camera.from_picture import FOCAL_STD
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.reconstruct import Solved
from drocap_ros.reconstruction.together.timing import ShownMotion
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry
from drocap_ros.reconstruction.world.even_capture import keypoint_weights
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import metres_per_px, place_in_world
from drocap_ros.reconstruction.world.world_model import (
    Doubt,
    PlacedPoses,
    WorldConfig,
    WorldInput,
    config_of,
    world_config,
)

#: Errors of a camera on a tripod: of its attitude none but that of its placement.
_STANDING = WorldConfig(
    errors=CameraErrors(latency_s=1e-3, position_wander_m=0.002, attitude_wander_deg=0.01), checks=False
)
#: Errors of a path that two bodies give: their turns err by 4 degrees for a second, their ranges by a tenth.
_FOLLOWED = WorldConfig(
    errors=CameraErrors(latency_s=1e-3, position_wander_m=0.5, attitude_wander_deg=8.0), checks=False
)


@dataclass(frozen=True)
class View:
    """A recording in its own world, z up.

    solved : of the recording alone
    joints : (F, 17, 3) m; camera : there, its matrix known
    own_world : whether the recording has a world, by telemetry or by its picture; else that of its camera
    config : errors of the camera there
    """

    solved: Solved
    joints: np.ndarray
    camera: CameraPath
    own_world: bool
    config: WorldConfig

    @staticmethod
    def of(solved: Solved, name: str) -> View:
        """The view of a recording that was solved alone."""
        motion, camera = solved.motion, solved.camera
        if camera.matrix is None:
            raise InputError(
                f"{name}: expected a known lens, found none; add camera_matrix to the tracks, or the video"
            )
        if motion.frame == "world" and motion.camera_position is not None:
            if not camera.of_reports or camera.position is None:
                # Of reports the camera before the adjustment: its errors are to be found with all views.
                camera = camera.moved(motion.camera_rotation, motion.camera_position)
            view = View(solved, motion.joints3d[:, :17], camera, True, _STANDING)
            if view.stands and not camera.upright:
                return view
            config = (
                WorldConfig() if camera.errors is None else config_of(camera, world_config(solved.settings.adjuster))
            )
            return replace(view, config=replace(config, checks=False))
        turn = np.broadcast_to(LEVEL_CAMERA, motion.camera_rotation.shape).copy()
        standing = camera.moved(turn, np.zeros((len(turn), 3)))
        view = View(solved, motion.joints3d, standing, False, _STANDING)
        poses = solved.poses
        placed = place_in_world(in_camera_axes(poses, view.per_px), poses.in_image[..., :2], view.per_px, standing)
        return replace(view, joints=placed.joints)

    @property
    def reported(self) -> bool:
        """Whether the world is that of telemetry: east, north and up."""
        return self.own_world and self.camera.of_reports

    @property
    def focal_std(self) -> float:
        """Of the logarithm of the focal length."""
        camera = self.solved.camera
        if camera.lens == "given":
            return 0.0
        return FOCAL_STD if camera.picture is None else camera.picture.focal_std

    @property
    def errors(self) -> np.ndarray | None:
        """(F, 6, 6) covariance of a reported camera's position and rotation beyond ``config``; None = none."""
        return self.solved.camera.covariance if self.solved.camera.of_reports else None

    @property
    def per_px(self) -> np.ndarray:
        """(F,) metres per px at the assumed stature."""
        shape = true_shape(self.solved.poses.in_image, self.camera.matrix)
        return metres_per_px(shape, self.camera.stamp_ns, self.solved.settings.initializer.assumed_height_m)

    @property
    def time_s(self) -> np.ndarray:
        """(F,) s since the first image."""
        stamps = self.camera.stamp_ns
        return np.asarray((stamps - stamps[0]) * 1e-9)

    def joints_at(self, time_s: np.ndarray) -> np.ndarray:
        """(S, 17, 3) m of the body as this view alone has it, at times (S,) s of its clock."""
        flat = self.joints.reshape(len(self.joints), -1)
        at = np.stack([np.interp(time_s, self.time_s, column) for column in flat.T], axis=1)
        return at.reshape(len(time_s), -1, 3)

    def shown(self) -> ShownMotion:
        """The motion with the images that show it."""
        return ShownMotion(self.joints, self.time_s, np.asarray((self.solved.keypoints.weights > 0).any(axis=1)))

    @property
    def stands(self) -> bool:
        """Whether the camera stands."""
        # Way (m) within which a camera stands.
        return bool(np.ptp(self.camera.pose[1], axis=0).max() < 0.05)

    def moved(self, scale: float, rotation: np.ndarray, translation: np.ndarray) -> View:
        """The view in another world: ``place there = scale * rotation @ place + translation``, by image or for all."""
        (turn, path), back = self.camera.pose, np.swapaxes(rotation, -1, -2)
        return replace(
            self,
            joints=scale * self.joints @ back + translation[..., None, :],
            camera=self.camera.moved(turn @ back, scale * (path[:, None] @ back)[:, 0] + translation),
            config=_FOLLOWED if rotation.ndim > 2 else self.config,
        )

    def placed_poses(self, joints: np.ndarray) -> PlacedPoses:
        """Input of the adjustment with other joints (F, 17, 3) m in the world."""
        sigma, depth = self._depth()
        image = self.solved.poses.sigma_px
        assert image is not None
        return PlacedPoses(
            joints, 1.0, depth, sigma, self.solved.poses.in_image[..., :2], image[..., 0], self.solved.poses.still
        )

    def at(self, time_s: np.ndarray, doubt: Doubt) -> WorldInput:
        """What the view shows at times (S,) s of its own clock; no weight where it shows nothing."""
        (turn, path), matrix, solved, own = self.camera.pose, self.camera.matrix, self.solved, self.time_s
        assert matrix is not None
        after = np.clip(np.searchsorted(own, time_s), 1, len(own) - 1)
        step = _Between(own, after - 1, after, time_s)
        assert solved.poses.sigma_px is not None
        weight, image = (
            keypoint_weights(solved.keypoints, solved.poses.sigma_px[..., 0]),
            solved.poses.in_image[..., :2],
        )
        # Keypoints have their own neighbours: a network may see a joint in every second image only.
        joint = _seen_beside(solved.keypoints.weights > 0, after, own, time_s)
        seen, guess = joint.inside, step.inside[:, None] & (solved.keypoints.weights[after - 1] == 0)
        xy = np.where(seen[..., None], joint.of(np.nan_to_num(solved.keypoints.xy)), step.of(image))
        guess &= ~seen & (solved.keypoints.weights[after] == 0)
        sigma, depth = self._depth()
        wander_m = max(self.config.errors.position_wander_m, doubt.wander_m)
        still = solved.poses.still
        return WorldInput(
            keypoints=xy,
            weight=np.where(seen, joint.least(weight), np.where(guess, step.least(weight), 0.0)),
            depth=step.of(depth),
            # Where the view shows nothing its depths weigh nothing.
            depth_sigma=np.where(step.inside[:, None], step.of(sigma), 1e6),
            lengths=np.zeros(0),
            telemetry=CameraTelemetry(project_to_so3(step.of(turn)), step.of(path), 1.0 / usual_step(time_s)),
            camera_matrix=matrix,
            config=replace(self.config, errors=replace(self.config.errors, position_wander_m=wander_m)),
            seen=seen,
            still=None if still is None else np.where(step.inside[:, None], step.of(still), 0.5),
            doubt=doubt,
        )

    def _depth(self) -> tuple[np.ndarray, np.ndarray]:
        """(F, 17) m expected error of depths behind the pelvis, and these."""
        poses, per_px = self.solved.poses, self.per_px
        assert poses.sigma_px is not None
        return poses.sigma_px[..., 1] * per_px[:, None], in_camera_axes(poses, per_px)[..., 2]


class _Between:
    """Interpolation between rows ``before`` and ``after`` of an image's values, (S,) or of every joint (S, P).

    inside : whether both are near enough
    """

    def __init__(self, own_s: np.ndarray, before: np.ndarray, after: np.ndarray, time_s: np.ndarray) -> None:
        joints = () if before.ndim == 1 else (np.arange(before.shape[1]),)
        self._rows = (before, *joints), (after, *joints)
        time_s = time_s.reshape(-1, *(1,) * (before.ndim - 1))
        gap = own_s[after] - own_s[before]
        # In no time nothing is passed.
        self._part = np.clip((time_s - own_s[before]) / np.where(gap > 0.0, gap, np.inf), 0.0, 1.0)
        # Longest time (s) between two images between which a joint is interpolated.
        near = gap < max(0.1, 1.5 * usual_step(own_s))
        self.inside = near & (time_s >= own_s[before]) & (time_s <= own_s[after])

    def of(self, values: np.ndarray) -> np.ndarray:
        """Interpolated values."""
        before, after = (values[rows] for rows in self._rows)
        share = self._part.reshape(*self._part.shape, *(1,) * (before.ndim - self._part.ndim))
        return np.asarray(before + share * (after - before))

    def least(self, values: np.ndarray) -> np.ndarray:
        """The smaller of both."""
        before, after = (values[rows] for rows in self._rows)
        return np.asarray(np.minimum(before, after))


def _seen_beside(seen: np.ndarray, after: np.ndarray, own_s: np.ndarray, time_s: np.ndarray) -> _Between:
    """Between the nearest images (S, P) that show each joint; ``seen`` : (F, P)."""
    frames = np.arange(len(seen))[:, None]
    last = np.maximum.accumulate(np.where(seen, frames, -1), axis=0)[after - 1]
    following = np.minimum.accumulate(np.where(seen, frames, len(seen))[::-1], axis=0)[::-1][after]
    none = (last < 0) | (following >= len(seen))
    between = _Between(own_s, np.where(none, 0, last), np.where(none, 0, following), time_s)
    between.inside &= ~none
    return between
