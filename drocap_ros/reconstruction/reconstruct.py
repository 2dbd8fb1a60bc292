"""Offline reconstruction: 2D tracks to a motion by one of the methods."""

from __future__ import annotations

import dataclasses
import platform
import time
from typing import TypeAlias

import numpy as np

from drocap_ros import __version__
from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.body_input import body_evidence, body_keypoints
from drocap_ros.reconstruction.camera.fusion import FusedTelemetry, fuse_telemetry, with_fusion
from drocap_ros.reconstruction.camera.kinds import Kind
from drocap_ros.reconstruction.camera.picture_world import (
    PictureWorld,
    at_assumed_stature,
    picture_camera,
    with_camera,
)
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput, Progress
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.common.threads import blas_threads
from drocap_ros.reconstruction.heels import with_heels
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.methods.run import run_method
from drocap_ros.reconstruction.paper.dictionary import REFERENCE_STATURE_M
from drocap_ros.reconstruction.person_view import lens_word, person_view, true_shape, with_lens
from drocap_ros.reconstruction.world.in_world import in_world
from drocap_ros.reconstruction.world.placement import WorldPoses, metres_per_px
from drocap_ros.reconstruction.world.refine import RefinedWorld, refinable
from drocap_ros.reconstruction.world.world_model import world_config
from drocap_ros.revision import git_revision
from drocap_ros.skeleton import BODY_17, BODY_19, JointSet
from drocap_ros.tracks import Tracks

#: Steps of each of the body's adjustments where the one in the world goes on from them: more change nothing there.
_STEPS_BEFORE_WORLD = 2


#: What knows the camera better than the telemetry as reported.
_Source: TypeAlias = FusedTelemetry | PictureWorld | None


@dataclasses.dataclass(frozen=True)
class _Settings:
    method: str
    initializer: InitializerConfig
    adjuster: BundleAdjusterConfig
    progress: Progress
    lens: str

    @property
    def body(self) -> JointSet:
        return METHODS[self.method].joints


@dataclasses.dataclass(frozen=True)
class _Body:
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


def reconstruct(
    tracks: Tracks,
    *,
    method: str = "ba",
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
) -> Motion:
    """3D motion of the subject of ``tracks``.

    Parameters
    ----------
    tracks : joints by the names of BODY_17 or of a set in :mod:`drocap_ros.joint_maps`, COCO for one; the model
        estimates missing ones, others are ignored
    method : a name in :data:`~drocap_ros.reconstruction.methods.METHODS`
    progress : called with a stage and its fraction done

    Returns
    -------
    Motion
        In frame "world" when the tracks hold the camera's rotation, else in frame "camera"; with the joints of the
        method, ``BODY_17`` or ``BODY_15``, and by the default method with the heels where the tracks hold them.

    Raises
    ------
    InputError
        When the method is unknown or too few joints are seen.
    """
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}; choose one of them")
    adjuster = adjuster or BundleAdjusterConfig()
    given, tracks = tracks, with_lens(tracks, adjuster.assumed_focal)
    settings = _Settings(
        method, initializer or InitializerConfig(), adjuster, progress or (lambda *_: None), lens_word(given, tracks)
    )
    clock = time.perf_counter()
    every_joint = body_keypoints(tracks, BODY_19)
    keypoints = every_joint.with_joints(len(settings.body))
    with blas_threads(settings.adjuster.threads):
        fused = fuse_telemetry(tracks, world_config(settings.adjuster))
        corrected = time.perf_counter()
        if isinstance(fused, Refusal):
            found: tuple[ImagePoses, _Body, float] | Refusal = fused
        else:
            found = _solved(tracks if fused is None else fused.tracks, keypoints, settings, fused)
        if isinstance(found, Refusal):
            # The lifter saw the camera's rotation: without it the poses differ too.
            refusal, tracks = found, dataclasses.replace(tracks, camera_rotation=None, camera_position=None)
            found = _solved(tracks, keypoints, settings)
            assert not isinstance(found, Refusal)
            found[1].meta["telemetry_rejected"] = str(refusal)
    poses, body, solved = found
    if body.frame == "world" and body.camera_position is None:
        body = dataclasses.replace(body, camera_position=given.camera_position)
    motion = Motion(
        joints=settings.body.joints,
        parents=settings.body.parents,
        stamp_ns=tracks.stamp_ns,
        confidence=keypoints.weights,
        keypoints=keypoints.xy,
        **{field.name: getattr(body, field.name) for field in dataclasses.fields(body)},
    )
    if settings.body is BODY_17:
        motion = with_heels(motion, every_joint.without_joints(len(BODY_17)), poses.in_image)
    seconds = dict(poses.report.seconds)
    if fused is not None:
        seconds["camera"] = corrected - clock
    if motion.frame == "world":
        seconds["world"] = time.perf_counter() - solved
    total = time.perf_counter() - clock
    motion.meta.update(
        _meta(poses, settings), seconds={**seconds, "other": total - sum(seconds.values()), "total": total}
    )
    return motion


def _solved(
    tracks: Tracks, keypoints: Keypoints2D, settings: _Settings, fused: FusedTelemetry | None = None
) -> tuple[ImagePoses, _Body, float] | Refusal:
    """Poses in px and in metres, and the time between both; a refusal where the telemetry cannot be true."""
    source: _Source = fused
    poses: ImagePoses | None = None
    if tracks.camera_rotation is None:
        tracks, source, settings, poses = _with_picture(tracks, keypoints, settings)
    poses = _solve(tracks, keypoints, settings) if poses is None else poses
    solved = time.perf_counter()
    body = _in_metres(tracks, keypoints, poses, settings, source)
    return body if isinstance(body, Refusal) else (poses, body, solved)


def _with_picture(
    tracks: Tracks, keypoints: Keypoints2D, settings: _Settings
) -> tuple[Tracks, PictureWorld | None, _Settings, ImagePoses | None]:
    """Tracks without telemetry with the camera that their fixed points give, and the poses where these are final.

    Its up and metres come from poses without it; then the lifter sees the camera's rotation, where up is sure.
    """
    assumed = settings.lens == "assumed"
    camera = picture_camera(dataclasses.replace(tracks, camera_matrix=None) if assumed else tracks)
    if camera is None or not camera.kind.known:
        return tracks, None if camera is None else PictureWorld(camera), settings, None
    # A camera that stands measures no lens.
    lens = settings.lens if settings.lens == "given" else "assumed" if camera.kind is Kind.STANDS else "picture"
    settings = dataclasses.replace(settings, lens=lens)
    tracks = dataclasses.replace(tracks, camera_matrix=camera.matrix)
    poses = _solve(tracks, keypoints, settings)
    per_px = metres_per_px(poses.joints_px, tracks.stamp_ns, settings.initializer.assumed_height_m)
    tracks, world = with_camera(tracks, camera, poses, per_px, world_config(settings.adjuster))
    return tracks, world, settings, poses if world.config is None else None


def _solve(tracks: Tracks, keypoints: Keypoints2D, settings: _Settings) -> ImagePoses:
    """Poses in px by the method."""
    k, adjuster = tracks.camera_matrix, settings.adjuster
    if refinable(tracks):
        first, final = (min(n, _STEPS_BEFORE_WORLD) for n in (adjuster.limb_iterations_first, adjuster.limb_iterations))
        adjuster = dataclasses.replace(adjuster, limb_iterations_first=first, limb_iterations=final)
    view = None if _by_place(tracks, settings) else person_view(keypoints, k, tracks.camera_rotation, tracks.image_size)
    data = MethodInput(
        stamp_ns=tracks.stamp_ns,
        keypoints=keypoints if view is None else view.keypoints(keypoints),
        focal_px=None if k is None else 0.5 * float(k[0, 0] + k[1, 1]),
        initializer=settings.initializer,
        adjuster=adjuster,
        progress=settings.progress,
        rotation=tracks.camera_rotation if view is None else view.rotation(tracks.camera_rotation),
    )
    if (evidence := body_evidence(tracks, len(settings.body))) is not None:
        data = dataclasses.replace(data, evidence=evidence if view is None else evidence.turned(view.turn))
    poses = run_method(settings.method, data)
    if not np.isfinite(poses.joints_px).all(axis=(1, 2)).any():
        raise InputError("keypoints: expected those of a person, got none that give a finite pose; check the values")
    return poses if view is None else view.in_image(poses)


def _by_place(tracks: Tracks, settings: _Settings) -> bool:
    """Whether the person is taken as in the middle of the picture: with nothing but an assumed lens.

    On phone videos a turn by nothing but the place in the picture bends the knees more: 8.3 degrees off, 7.2 without.
    """
    return settings.lens == "assumed" and tracks.camera_rotation is None


def _meta(poses: ImagePoses, settings: _Settings) -> dict[str, object]:
    """What made the motion."""
    report, origin = poses.report, dict(poses.report.origin)
    parameters = {"initializer": settings.initializer, "adjuster": settings.adjuster, **origin.pop("parameters", {})}
    if poses.sigma_px is not None:  # of what the adjustment in the world starts from
        parameters["world"] = world_config(settings.adjuster)
    return {
        "method": settings.method,
        "versions": {"drocap_ros": __version__, "numpy": np.__version__, "python": platform.python_version()},
        "git_revision": git_revision(),
        "parameters": {name: dataclasses.asdict(values) for name, values in parameters.items()},
        "iterations": report.iterations,
        "stop_reason": report.stop_reason,
        "cost_terms": report.cost_terms,
        "frames": len(poses.joints_px),
        **origin,
    }


def _in_metres(
    tracks: Tracks,
    keypoints: Keypoints2D,
    poses: ImagePoses,
    settings: _Settings,
    source: _Source = None,
) -> _Body | Refusal:
    """The one step from px to m: in the world where the camera's rotation is known, else in the camera's axes.

    In the world the poses are placed by the reported camera and, with its position and matrix, adjusted with it.  The
    answer is a refusal where its telemetry cannot be true.
    """
    height_m = settings.initializer.assumed_height_m
    alone = isinstance(source, PictureWorld) and source.config is None  # the body is as without a world
    by_place = _by_place(dataclasses.replace(tracks, camera_rotation=None) if alone else tracks, settings)
    shape = true_shape(poses.in_image, tracks.camera_matrix, about_pelvis=by_place)
    per_px = metres_per_px(shape, tracks.stamp_ns, height_m)
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
    if isinstance(source, PictureWorld):
        placed = dataclasses.replace(placed, metric=False, scale_source="assumed_height")
        meta["camera"] = source.meta()
    if placed.scale is not None:
        meta["scale"] = dataclasses.asdict(placed.scale)
    body = _Body(
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
    if source is not None:
        refined = at_assumed_stature(refined) if isinstance(source, PictureWorld) else with_fusion(refined, source)
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


def _covariance(poses: ImagePoses, per_px: np.ndarray, rotation: np.ndarray) -> np.ndarray | None:
    """(F, P, 6) m^2 about the pelvis of the expected errors across and along the ray; rotation is world -> camera."""
    if poses.sigma_px is None:
        return None
    std = poses.sigma_px * per_px[:, None, None] * np.array(poses.std_over_sigma)
    variance = np.square(std)[..., [0, 0, 1]]
    full = np.einsum("fki,fpk,fkj->fpij", rotation, variance, rotation)
    packed: np.ndarray = full[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return packed


def reprojection_px(
    joints: np.ndarray, rotation: np.ndarray, position: np.ndarray, matrix: np.ndarray | None, keypoints: np.ndarray
) -> np.ndarray:
    """(F, P) px, distance of joints in the world, as a camera there projects them, from keypoints; NaN = not seen."""
    assert matrix is not None
    seen = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    projected = seen[..., :2] / np.maximum(seen[..., 2:], 1e-3) * np.diagonal(matrix)[:2] + matrix[:2, 2]
    distance: np.ndarray = np.linalg.norm(projected - keypoints, axis=-1)
    return distance
