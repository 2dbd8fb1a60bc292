"""From poses in px to bodies in metres: in the world where the camera is known, else in the camera's axes."""

from __future__ import annotations

import dataclasses
from typing import TypeAlias

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.camera.fusion import FusedTelemetry, with_fusion
from drocap_ros.reconstruction.camera.picture_world import PictureWorld, at_assumed_stature, seen_from_camera
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, Progress
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.common.spread import packed
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.paper.dictionary import REFERENCE_STATURE_M
from drocap_ros.reconstruction.person_view import aside, true_shape
from drocap_ros.reconstruction.shared_camera import SharedCamera
from drocap_ros.reconstruction.world.in_world import in_world
from drocap_ros.reconstruction.world.placement import WorldPoses, metres_per_px
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import world_config
from drocap_ros.skeleton import JointSet
from drocap_ros.tracks import Tracks

#: What knows the camera better than the telemetry as reported.
Source: TypeAlias = FusedTelemetry | PictureWorld | SharedCamera | None


@dataclasses.dataclass(frozen=True)
class Settings:
    """What the steps of one reconstruction have in common; ``lens`` : where the camera's matrix comes from."""

    method: str
    initializer: InitializerConfig
    adjuster: BundleAdjusterConfig
    progress: Progress
    lens: str

    @property
    def body(self) -> JointSet:
        """Joints of the method."""
        return METHODS[self.method].joints


@dataclasses.dataclass(frozen=True)
class Body:
    """Poses in m, with the camera: the fields of :class:`Motion` of the same names."""

    joints3d: np.ndarray
    frame: str
    metric: bool
    scale_source: str
    camera_rotation: np.ndarray
    camera_position: np.ndarray | None
    reprojection_px: np.ndarray
    covariance: np.ndarray | None
    meta: dict[str, object]


def by_place(tracks: Tracks, settings: Settings) -> bool:
    """Whether the person is taken as in the middle of the picture: with nothing but an assumed lens.

    On phone videos a turn by nothing but the place in the picture bends the knees more: 8.3 degrees off, 7.2 without.
    """
    return settings.lens == "assumed" and tracks.camera_rotation is None


def in_metres(
    tracks: Tracks,
    keypoints: Keypoints2D,
    poses: ImagePoses,
    settings: Settings,
    source: Source = None,
) -> Body | Refusal:
    """The one step from px to m: in the world where the camera's rotation is known, else in the camera's axes.

    In the world the poses are placed by the reported camera and, with its position and matrix, adjusted with it.  The
    answer is a refusal where its telemetry cannot be true.
    """
    height_m, alone = settings.initializer.assumed_height_m, _alone(source)
    about_pelvis = by_place(dataclasses.replace(tracks, camera_rotation=None) if alone else tracks, settings)
    shape = true_shape(poses.in_image, tracks.camera_matrix, about_pelvis=about_pelvis)
    per_px = metres_per_px(shape, tracks.stamp_ns, height_m)
    if isinstance(source, SharedCamera):
        seen = aside(poses, tracks.camera_matrix) if about_pelvis and tracks.camera_matrix is not None else poses
        factor, std = source.stature(seen_from_camera(tracks, seen, per_px))
        height_m, per_px, source = factor * height_m, factor * per_px, source.for_stature(std)
    meta: dict[str, object] = {
        "lens": settings.lens,
        "assumed_height_m": height_m,
        "reference_stature_m": REFERENCE_STATURE_M,
    }
    refined: RefinedWorld | None = None
    rotation = tracks.camera_rotation
    if rotation is None:
        rotation, frame = np.broadcast_to(np.eye(3), (len(tracks), 3, 3)).copy(), "camera"
        placed = WorldPoses(shape * per_px[:, None, None], False, "assumed_height", None)
    else:
        frame = "world"
        config = world_config(settings.adjuster) if source is None else source.config
        placed, refined, refusal = in_world(tracks, keypoints, poses, per_px, config)
        if refusal is not None:
            return refusal
        if alone:
            about = (shape - shape[:, :1]) * per_px[:, None, None]
            placed = dataclasses.replace(placed, joints=placed.joints[:, :1] + about @ rotation)
    placed = _with_scale_of(source, placed, meta)
    if placed.scale is not None:
        meta["scale"] = dataclasses.asdict(placed.scale)
    body = Body(
        joints3d=np.ascontiguousarray(placed.joints),
        frame=frame,
        metric=placed.metric,
        scale_source=placed.scale_source,
        camera_rotation=rotation,
        camera_position=tracks.camera_position if frame == "world" else None,
        reprojection_px=np.linalg.norm(poses.in_image[..., :2] - keypoints.xy, axis=-1),
        covariance=_covariance(poses, per_px, rotation),
        meta=meta,
    )
    if refined is None:
        if body.covariance is not None:
            meta["covariance_about"] = "pelvis"
        return body
    refined = _with_camera_of(source, refined, settings.adjuster.stature_std)
    meta["calibration"], meta["covariance_about"] = refined.calibration, "origin"
    camera = refined.rotation, refined.position
    return dataclasses.replace(
        body,
        joints3d=np.ascontiguousarray(refined.joints),
        metric=refined.metric,
        scale_source="telemetry" if refined.metric else "assumed_height",
        camera_rotation=refined.rotation,
        camera_position=refined.position,
        reprojection_px=reprojection_px(refined.joints, *camera, tracks.camera_matrix, keypoints.xy),
        covariance=refined.covariance,
    )


def _alone(source: Source) -> bool:
    """Whether the camera is known, its up is unsure, and the body stays as without a world."""
    return isinstance(source, PictureWorld | SharedCamera) and source.config is None


def _with_scale_of(source: Source, placed: WorldPoses, meta: dict[str, object]) -> WorldPoses:
    """Placed poses with the source of their metres; ``meta`` gets the words about a camera from the picture."""
    if isinstance(source, PictureWorld):
        meta["camera"] = source.meta()
        return dataclasses.replace(placed, metric=False, scale_source="assumed_height")
    if isinstance(source, SharedCamera):
        meta |= {} if source.words is None else {"camera": source.words}
        return dataclasses.replace(placed, metric=placed.metric and source.metric, scale_source=source.scale_source)
    return placed


def _with_camera_of(source: Source, refined: RefinedWorld, stature_std: float) -> RefinedWorld:
    """The adjusted world with what is known of its camera."""
    if isinstance(source, PictureWorld):
        return at_assumed_stature(refined, source, stature_std)
    if isinstance(source, FusedTelemetry):
        return with_fusion(refined, source)
    return refined if source is None else source.holds(refined)


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
