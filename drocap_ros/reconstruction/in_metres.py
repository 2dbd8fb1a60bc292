"""From poses in px to bodies in metres: in the world where the camera is known, else in the camera's axes."""

from __future__ import annotations

import dataclasses

import numpy as np

from drocap_ros.camera_path import CameraPath, Teller
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.camera.fusion import with_measured
from drocap_ros.reconstruction.camera.picture_world import at_assumed_stature, on_ground, seen_from_camera
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, Progress, packed
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.paper.dictionary import REFERENCE_STATURE_M
from drocap_ros.reconstruction.person_view import aside, true_shape
from drocap_ros.reconstruction.shared_camera import held, stature
from drocap_ros.reconstruction.world.in_world import in_world
from drocap_ros.reconstruction.world.placement import WorldPoses, metres_per_px
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import config_of, world_config
from drocap_ros.skeleton import JointSet


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the steps of one reconstruction have in common."""

    method: str
    initializer: InitializerConfig
    adjuster: BundleAdjusterConfig
    progress: Progress

    @property
    def body(self) -> JointSet:
        """Joints of the method."""
        return METHODS[self.method].joints


def as_seen(camera: CameraPath) -> CameraPath:
    """The camera as far as a method may see it: a rotation whose up is unsure bends bodies."""
    return camera if camera.upright else dataclasses.replace(camera, rotation=None, position=None)


def by_place(camera: CameraPath) -> bool:
    """Whether the person is taken as in the middle of the picture: with nothing but an assumed lens.

    On phone videos a turn by nothing but the place in the picture bends the knees more: 8.3 degrees off, 7.2 without.
    """
    return camera.lens == "assumed" and as_seen(camera).rotation is None


def in_metres(keypoints: Keypoints2D, poses: ImagePoses, camera: CameraPath, settings: Settings) -> Motion | Refusal:
    """The one step from px to m: in the world where the camera's rotation is known, else in the camera's axes.

    In the world the poses are placed by the camera and, with its position and matrix, adjusted with it.  The answer
    is a refusal where its telemetry cannot be true.
    """
    height_m, stamp_ns, config = settings.initializer.assumed_height_m, camera.stamp_ns, world_config(settings.adjuster)
    shape = true_shape(poses.in_image, camera.matrix, about_pelvis=by_place(camera))
    per_px = metres_per_px(shape, stamp_ns, height_m)
    if camera.teller is Teller.PERSON:
        assert camera.matrix is not None
        seen = aside(poses, camera.matrix) if by_place(camera) else poses
        factor, std = stature(camera, seen_from_camera(camera, seen, per_px))
        height_m, per_px, camera = factor * height_m, factor * per_px, dataclasses.replace(camera, scale_std=std)
    meta: dict[str, object] = {
        "lens": camera.lens,
        "assumed_height_m": height_m,
        "reference_stature_m": REFERENCE_STATURE_M,
    }
    meta |= {} if camera.words is None else {"camera": camera.words}
    about = shape * per_px[:, None, None]
    refined: RefinedWorld | None = None
    if camera.rotation is None:
        rotation, frame = np.broadcast_to(np.eye(3), (len(stamp_ns), 3, 3)).copy(), "camera"
        placed = WorldPoses(about, False, "assumed_height", None)
    else:
        rotation, frame = camera.rotation, "world"
        seen = poses if camera.matrix is None or not by_place(camera) else aside(poses, camera.matrix)
        if camera.stands_on_points:
            per_px = on_ground(camera, seen, per_px)
        placed, found = in_world(camera, keypoints, seen, per_px, config_of(camera, config))
        if isinstance(found, Refusal):
            return found
        refined = found
    if camera.teller in (Teller.PICTURE, Teller.PERSON):
        metric = placed.metric and camera.metric
        placed = dataclasses.replace(placed, metric=metric, scale_source=camera.scale_source)
    if placed.scale is not None:
        meta["scale"] = dataclasses.asdict(placed.scale)
    motion = Motion(
        joints3d=np.ascontiguousarray(placed.joints),
        joints=settings.body.joints,
        parents=settings.body.parents,
        stamp_ns=stamp_ns,
        frame=frame,
        metric=placed.metric,
        scale_source=placed.scale_source,
        camera_rotation=rotation,
        confidence=keypoints.weights,
        keypoints=keypoints.xy,
        camera_position=camera.position if frame == "world" else None,
        reprojection_px=np.linalg.norm(poses.in_image[..., :2] - keypoints.xy, axis=-1),
        covariance=_covariance(poses, per_px, rotation),
        meta=meta,
    )
    if refined is None:
        if motion.covariance is not None:
            meta["covariance_about"] = "pelvis"
        return motion
    refined = _by_camera(refined, camera, settings.adjuster.stature_std)
    meta["calibration"], meta["covariance_about"] = refined.calibration, "origin"
    pose = refined.rotation, refined.position
    return dataclasses.replace(
        motion,
        joints3d=np.ascontiguousarray(refined.joints),
        metric=refined.metric,
        scale_source="telemetry" if refined.metric else "assumed_height",
        camera_rotation=refined.rotation,
        camera_position=refined.position,
        reprojection_px=reprojection_px(refined.joints, *pose, camera.matrix, keypoints.xy),
        covariance=refined.covariance,
    )


def _by_camera(refined: RefinedWorld, camera: CameraPath, stature_std: float) -> RefinedWorld:
    """The adjusted world with what is known of its camera beside the adjustment."""
    if camera.teller is Teller.PERSON:
        refined = held(refined, camera)
    refined = with_measured(refined, camera)
    return at_assumed_stature(refined, stature_std) if camera.teller is Teller.PICTURE else refined


def _covariance(poses: ImagePoses, per_px: np.ndarray, rotation: np.ndarray) -> np.ndarray | None:
    """(F, P, 6) m^2 about the pelvis; rotation (F, 3, 3) is world -> camera."""
    if poses.sigma_px is None:
        return None
    metres = per_px[:, None, None]
    full = poses.spread.covariance(poses.in_image * metres, poses.sigma_px * metres)
    return packed(np.swapaxes(rotation, 1, 2)[:, None] @ full @ rotation[:, None])


def reprojection_px(
    joints: np.ndarray, rotation: np.ndarray, position: np.ndarray, matrix: np.ndarray | None, keypoints: np.ndarray
) -> np.ndarray:
    """(F, P) px, distance of joints in the world, as a camera there projects them, from keypoints; NaN = not seen."""
    assert matrix is not None
    seen = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    projected = seen[..., :2] / np.maximum(seen[..., 2:], 1e-3) * np.diagonal(matrix)[:2] + matrix[:2, 2]
    distance: np.ndarray = np.linalg.norm(projected - keypoints, axis=-1)
    return distance
