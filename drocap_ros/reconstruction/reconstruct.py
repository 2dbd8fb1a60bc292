"""Offline reconstruction: 2D tracks to a motion by one of the methods."""

from __future__ import annotations

import dataclasses
import platform
import time
from typing import NamedTuple

import numpy as np

from drocap_ros import __version__
from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.balance import balanced
from drocap_ros.reconstruction.body_input import body_evidence, body_keypoints
from drocap_ros.reconstruction.camera.cuts import cut_times
from drocap_ros.reconstruction.camera.fusion import FusedTelemetry, fuse_telemetry, with_causes
from drocap_ros.reconstruction.camera.kinds import Kind
from drocap_ros.reconstruction.camera.picture_world import (
    PictureWorld,
    picture_camera,
    with_camera,
)
from drocap_ros.reconstruction.camera.upright import UpSource
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput, Progress
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.common.threads import blas_threads
from drocap_ros.reconstruction.heels import with_heels
from drocap_ros.reconstruction.in_metres import Body, Settings, Source, by_place, in_metres
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.methods.run import run_method
from drocap_ros.reconstruction.person_view import aside, lens_word, person_view, true_shape, with_lens
from drocap_ros.reconstruction.shared_camera import SharedCamera, held, lower_ankle
from drocap_ros.reconstruction.world.placement import metres_per_px
from drocap_ros.reconstruction.world.refine import refinable
from drocap_ros.reconstruction.world.world_model import WorldConfig, world_config
from drocap_ros.revision import git_revision
from drocap_ros.skeleton import BODY_17, BODY_19
from drocap_ros.tracks import Tracks

#: Steps of each of the body's adjustments where the one in the world goes on from them: more change nothing there.
_STEPS_BEFORE_WORLD = 2


class _Solved(NamedTuple):
    """Poses in px and in metres, the time between both, and the camera that was used."""

    poses: ImagePoses
    body: Body
    solved: float
    tracks: Tracks
    source: Source
    lens: str


class SolvedView(NamedTuple):
    """A recording's motion, and what an adjustment with other recordings goes on from.

    tracks : with the lens in use, and the camera that the motion has before its adjustment, where there is one
    keypoints : of the method's joints
    poses : in px; per_px : (F,) metres per px at the assumed stature
    config : of the adjustment in the world, with the errors of that camera; None = it was not adjusted
    camera_covariance : (F, 6, 6) of its position (m) and rotation (rad, camera axes) beyond these; None = none
    """

    motion: Motion
    tracks: Tracks
    keypoints: Keypoints2D
    poses: ImagePoses
    per_px: np.ndarray
    config: WorldConfig | None
    camera_covariance: np.ndarray | None


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
    tracks : joints by the names of BODY_17 or of a set in :mod:`drocap_ros.skeleton`, COCO for one; the model
        estimates missing ones, others are ignored
    method : a name in :data:`~drocap_ros.reconstruction.methods.METHODS`
    progress : called with a stage and its fraction done

    Returns
    -------
    Motion
        In frame "world" when the tracks hold the camera's rotation, else in frame "camera"; with the joints of the
        method, ``BODY_17`` or ``BODY_15``, and by the default method with the heels where the tracks hold them.
        A clip without telemetry whose fixed points show cuts has no camera: frame "camera", ``meta["cuts_s"]``.
    """
    cuts_s = cut_times(tracks)
    motion, _ = reconstruct_with_camera(
        dataclasses.replace(tracks, background=None) if cuts_s else tracks,
        method=method,
        initializer=initializer,
        adjuster=adjuster,
        progress=progress,
    )
    return dataclasses.replace(motion, meta={**motion.meta, "cuts_s": cuts_s}) if cuts_s else motion


def reconstruct_with_camera(
    tracks: Tracks,
    *,
    method: str,
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
    camera: SharedCamera | None = None,
) -> tuple[Motion, SharedCamera | None]:
    """As :func:`reconstruct`, with the camera that others in the same images can share, where it has a place.

    camera : that of these images, as another person's reconstruction found it; None = it is to be found
    """
    motion, found, settings = _reconstructed(tracks, method, initializer, adjuster, progress, camera)
    return motion, camera or _shared(motion, found, settings)


def solve_view(
    tracks: Tracks,
    *,
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
) -> SolvedView:
    """As :func:`reconstruct` by the default method, for an adjustment with other recordings of the person."""
    motion, found, settings = _reconstructed(tracks, "ba", initializer, adjuster, progress)
    keypoints = body_keypoints(found.tracks, settings.body)
    shape = true_shape(found.poses.in_image, found.tracks.camera_matrix)
    per_px = metres_per_px(shape, found.tracks.stamp_ns, settings.initializer.assumed_height_m)
    config = world_config(settings.adjuster) if found.source is None else found.source.config
    errors = found.source.covariance if isinstance(found.source, FusedTelemetry) else None
    return SolvedView(motion, found.tracks, keypoints, found.poses, per_px, config, errors)


def _reconstructed(
    tracks: Tracks,
    method: str,
    initializer: InitializerConfig | None,
    adjuster: BundleAdjusterConfig | None,
    progress: Progress | None,
    camera: SharedCamera | None = None,
) -> tuple[Motion, _Solved, Settings]:
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}; choose one of them")
    adjuster = adjuster or BundleAdjusterConfig()
    given = tracks if camera is None else camera.given_to(tracks)
    tracks = with_lens(given, adjuster.assumed_focal)
    lens = lens_word(given, tracks) if camera is None else camera.lens
    settings = Settings(method, initializer or InitializerConfig(), adjuster, progress or (lambda *_: None), lens)
    clock = time.perf_counter()
    every_joint = body_keypoints(tracks, BODY_19)
    keypoints = every_joint.with_joints(len(settings.body))
    with blas_threads(settings.adjuster.threads):
        config = world_config(settings.adjuster)
        fused = fuse_telemetry(tracks, config) if camera is None else camera
        if camera is None and isinstance(fused, FusedTelemetry):
            fused = with_causes(fused, config)
        corrected = time.perf_counter()
        if isinstance(fused, Refusal):
            found: _Solved | Refusal = fused
        else:
            found = _solved(fused.tracks if isinstance(fused, FusedTelemetry) else tracks, keypoints, settings, fused)
        if isinstance(found, Refusal):
            # The lifter saw the camera's rotation: without it the poses differ too.
            refusal, tracks = found, dataclasses.replace(tracks, camera_rotation=None, camera_position=None)
            found = _solved(tracks, keypoints, settings)
            assert not isinstance(found, Refusal)
            found.body.meta["telemetry_rejected"] = str(refusal)
    poses, body = found.poses, found.body
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
    if isinstance(fused, FusedTelemetry | Refusal):
        seconds["camera"] = corrected - clock
    if motion.frame == "world":
        seconds["world"] = time.perf_counter() - found.solved
    total = time.perf_counter() - clock
    motion.meta.update(
        _meta(poses, settings), seconds={**seconds, "other": total - sum(seconds.values()), "total": total}
    )
    return motion, found, settings


def _shared(motion: Motion, found: _Solved, settings: Settings) -> SharedCamera | None:
    """The camera that the others in the images can share; None where it has no place in a world, or no lens."""
    source, matrix = found.source, found.tracks.camera_matrix
    if motion.frame != "world" or motion.camera_position is None or matrix is None:
        return None
    alone = isinstance(source, PictureWorld) and source.config is None
    return SharedCamera(
        motion.stamp_ns,
        motion.camera_rotation,
        motion.camera_position,
        matrix,
        found.lens,
        None if alone else held(world_config(settings.adjuster)),
        motion.metric,
        motion.scale_source,
        lower_ankle(motion),
        source.upright.std_deg if isinstance(source, PictureWorld) and source.upright is not None else 0.0,
        source.covariance if isinstance(source, FusedTelemetry) else None,
        source.meta() if isinstance(source, PictureWorld) else None,
    )


def _solved(
    tracks: Tracks, keypoints: Keypoints2D, settings: Settings, source: FusedTelemetry | SharedCamera | None = None
) -> _Solved | Refusal:
    """Poses in px and in metres; a refusal where the telemetry cannot be true."""
    known: Source = source
    poses: ImagePoses | None = None
    if tracks.camera_rotation is None:
        tracks, known, settings, poses = _with_picture(tracks, keypoints, settings)
    if poses is None:
        unsure = isinstance(known, SharedCamera) and known.config is None
        seen = dataclasses.replace(tracks, camera_rotation=None, camera_position=None) if unsure else tracks
        poses = _solve(seen, keypoints, settings, _points_tell_up(known))
    solved = time.perf_counter()
    body = in_metres(tracks, keypoints, poses, settings, known)
    return body if isinstance(body, Refusal) else _Solved(poses, body, solved, tracks, known, settings.lens)


def _with_picture(
    tracks: Tracks, keypoints: Keypoints2D, settings: Settings
) -> tuple[Tracks, PictureWorld | None, Settings, ImagePoses | None]:
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
    seen = aside(poses, camera.matrix) if by_place(tracks, settings) else poses
    placed, world = with_camera(tracks, camera, seen, per_px, world_config(settings.adjuster))
    if world.config is None:
        return placed, world, settings, poses
    if world.upright is not None and world.upright.source is UpSource.GROUND:
        # Poses that know up do not lean, and tell how far away they are.
        poses = _solve(placed, keypoints, settings, points_tell_up=True)
        per_px = metres_per_px(
            true_shape(poses.in_image, camera.matrix), tracks.stamp_ns, settings.initializer.assumed_height_m
        )
        placed, world = with_camera(tracks, camera, poses, per_px, world_config(settings.adjuster))
        return placed, world, settings, poses
    return placed, world, settings, None


def _points_tell_up(source: Source) -> bool:
    """Whether fixed points have measured the camera's pitch: else a body that leans may tell of a wrong one."""
    if isinstance(source, SharedCamera):
        return source.config is not None and (source.words is not None or source.covariance is not None)
    return isinstance(source, FusedTelemetry)


def _solve(tracks: Tracks, keypoints: Keypoints2D, settings: Settings, points_tell_up: bool = False) -> ImagePoses:
    """Poses in px by the method."""
    k, adjuster = tracks.camera_matrix, settings.adjuster
    if refinable(tracks):
        first, final = (min(n, _STEPS_BEFORE_WORLD) for n in (adjuster.limb_iterations_first, adjuster.limb_iterations))
        adjuster = dataclasses.replace(adjuster, limb_iterations_first=first, limb_iterations=final)
    view = None if by_place(tracks, settings) else person_view(keypoints, k, tracks.camera_rotation, tracks.image_size)
    data = MethodInput(
        stamp_ns=tracks.stamp_ns,
        keypoints=keypoints if view is None else view.keypoints(keypoints),
        focal_px=None if k is None else 0.5 * float(k[0, 0] + k[1, 1]),
        initializer=settings.initializer,
        adjuster=adjuster,
        progress=settings.progress,
        rotation=tracks.camera_rotation if view is None else view.rotation(tracks.camera_rotation),
        pictures=tracks.real_lens,
    )
    if (evidence := body_evidence(tracks, len(settings.body))) is not None:
        seen = view or person_view(keypoints, k, None, tracks.image_size)  # taken as in the middle
        data = dataclasses.replace(data, evidence=evidence if seen is None else evidence.turned(seen.turn))
    poses = run_method(settings.method, data)
    if not np.isfinite(poses.joints_px).all(axis=(1, 2)).any():
        raise InputError("keypoints: expected those of a person, got none that give a finite pose; check the values")
    if view is None:
        return poses
    if points_tell_up and data.rotation is not None:
        poses = balanced(poses, data.rotation, tracks.stamp_ns)
    return view.in_image(poses)


def _meta(poses: ImagePoses, settings: Settings) -> dict[str, object]:
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
