"""Offline reconstruction: 2D tracks to a motion by one of the methods."""

from __future__ import annotations

import dataclasses
import platform
import time
from typing import NamedTuple

import numpy as np

from drocap_ros import __version__
from drocap_ros.camera_path import CameraPath, Kind, Teller
from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.balance import balanced
from drocap_ros.reconstruction.body_input import body_evidence, body_keypoints
from drocap_ros.reconstruction.camera.fusion import fuse_telemetry, with_causes
from drocap_ros.reconstruction.camera.kinds import cut_times
from drocap_ros.reconstruction.camera.picture_world import picture_camera, with_camera, with_vertical
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.engine import blas_threads
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput, Progress
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.heels import with_heels
from drocap_ros.reconstruction.in_metres import Settings, as_seen, by_place, in_metres
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.methods.run import run_method
from drocap_ros.reconstruction.person_view import aside, lens_word, person_view, true_shape, with_lens
from drocap_ros.reconstruction.shared_camera import shared
from drocap_ros.reconstruction.world.placement import metres_per_px
from drocap_ros.reconstruction.world.refine import refinable
from drocap_ros.reconstruction.world.world_model import world_config
from drocap_ros.revision import git_revision
from drocap_ros.skeleton import BODY_17, BODY_19
from drocap_ros.tracks import Tracks

#: Steps of each of the body's adjustments where the one in the world goes on from them: more change nothing there.
_STEPS_BEFORE_WORLD = 2


class Solved(NamedTuple):
    """A motion, and what an adjustment with other recordings or persons goes on from.

    camera : before the adjustment that gave the motion
    keypoints : (F, P) of the method's joints; poses : in px
    """

    motion: Motion
    camera: CameraPath
    keypoints: Keypoints2D
    poses: ImagePoses
    settings: Settings

    @property
    def shared_camera(self) -> CameraPath | None:
        """The camera that others in the same images can share, where it has a place."""
        return shared(self.motion, self.camera)


def reconstruct(
    tracks: Tracks,
    *,
    method: str = "ba",
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
) -> Motion:
    """3D motion of the subject of ``tracks``.

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
    clip = dataclasses.replace(tracks, background=None) if cuts_s else tracks
    motion = solve(clip, method=method, initializer=initializer, adjuster=adjuster, progress=progress).motion
    return dataclasses.replace(motion, meta={**motion.meta, "cuts_s": cuts_s}) if cuts_s else motion


def solve(
    tracks: Tracks,
    *,
    method: str = "ba",
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    progress: Progress | None = None,
    shared_camera: CameraPath | None = None,
) -> Solved:
    """As :func:`reconstruct`, with what further adjustments need.

    shared_camera : that of these images, as another person's reconstruction found it; None = it is to be found
    """
    if method not in METHODS:
        raise InputError(f"method: expected one of {', '.join(METHODS)}, got {method!r}; choose one of them")
    settings = Settings(
        method, initializer or InitializerConfig(), adjuster or BundleAdjusterConfig(), progress or (lambda *_: None)
    )
    clock = _Clock()
    every_joint = body_keypoints(tracks, BODY_19)
    keypoints = every_joint.with_joints(len(settings.body))
    with blas_threads(settings.adjuster.threads):
        camera = shared_camera or reported_camera(tracks, settings)
        clock.lap("camera", counts=camera.refused or camera.teller is Teller.POINTS_AND_REPORTS)
        poses, camera = body_poses(tracks, keypoints, camera, settings)
        clock.lap("poses")
        motion = in_metres(keypoints, poses, camera, settings)
        if isinstance(motion, Refusal):
            # The lifter saw the camera's rotation: without it the poses differ too.
            camera = without_reports(camera, str(motion))
            poses, camera = body_poses(tracks, keypoints, camera, settings)
            clock.lap("poses")
            motion = in_metres(keypoints, poses, camera, settings)
            assert not isinstance(motion, Refusal)
    if motion.frame == "world" and motion.camera_position is None:  # an assumed lens has no place, the drone has one
        motion = dataclasses.replace(motion, camera_position=tracks.camera_position)
    if settings.body is BODY_17:
        motion = with_heels(motion, every_joint.without_joints(len(BODY_17)), poses.in_image)
    clock.lap("world", counts=motion.frame == "world")
    motion.meta.update(_meta(poses, settings), seconds=clock.seconds(poses.report.seconds))
    if camera.refused:
        motion.meta["telemetry_rejected"] = camera.refused
    return Solved(motion, camera, keypoints, poses, settings)


def reported_camera(tracks: Tracks, settings: Settings) -> CameraPath:
    """The camera as telemetry reports it, corrected by fixed points where there are enough; it may know nothing."""
    used = with_lens(tracks, settings.adjuster.assumed_focal)
    lens = CameraPath(used.stamp_ns, matrix=used.camera_matrix, lens=lens_word(tracks, used))
    if used.camera_rotation is None:
        return lens
    errors = settings.adjuster.telemetry_errors
    reports = lens.moved(used.camera_rotation, used.camera_position)
    reports = dataclasses.replace(reports, teller=Teller.REPORTS, errors=errors)
    fusion = fuse_telemetry(reports, used.background)
    if isinstance(fusion, Refusal):
        return without_reports(reports, str(fusion))
    return reports if fusion is None else with_causes(fusion, errors)


def without_reports(camera: CameraPath, why: str) -> CameraPath:
    """What is left of a camera whose telemetry cannot be true: its lens."""
    return CameraPath(camera.stamp_ns, matrix=camera.matrix, lens=camera.lens, refused=why)


def body_poses(
    tracks: Tracks, keypoints: Keypoints2D, camera: CameraPath, settings: Settings
) -> tuple[ImagePoses, CameraPath]:
    """Poses in px, and the camera, to which fixed points give a path where it has none.

    Up and metres of such a path come from poses that know neither; then the lifter sees the camera's rotation, where up
    is sure.
    """
    attitude = camera.rotation
    if camera.position is not None or (attitude is not None and camera.matrix is None):
        return _solve(tracks, keypoints, camera, settings), camera
    unknown = dataclasses.replace(camera, matrix=None) if camera.lens == "assumed" else camera
    found = picture_camera(unknown, tracks.background, tracks.image_size)
    if found is not None:
        camera = with_vertical(_of_picture(camera, found), tracks.vertical)
    elif attitude is not None:  # without a path the body stays at the origin
        return _solve(tracks, keypoints, camera, settings), camera
    poses = _solve(tracks, keypoints, as_seen(camera), settings)
    if camera.rotation is None:
        return poses, camera
    assert camera.matrix is not None
    height_m, raw = settings.initializer.assumed_height_m, camera
    per_px = metres_per_px(poses.joints_px, camera.stamp_ns, height_m)
    camera = with_camera(raw, aside(poses, camera.matrix) if by_place(raw) else poses, per_px)
    if not camera.upright:
        return poses, camera
    poses = _solve(tracks, keypoints, camera, settings)
    if camera.points_tell_up:
        # Poses that know up do not lean, and tell how far away they are.
        per_px = metres_per_px(true_shape(poses.in_image, camera.matrix), camera.stamp_ns, height_m)
        camera = with_camera(raw, poses, per_px)
    return poses, camera


def _of_picture(camera: CameraPath, found: CameraPath) -> CameraPath:
    """The camera with what the picture tells; a kind of camera that has no path tells no more than that."""
    assert found.picture is not None
    kind = found.picture.kind
    if not kind.known:
        told = CameraPath(camera.stamp_ns, matrix=camera.matrix, lens=camera.lens, teller=Teller.PICTURE)
        return dataclasses.replace(
            told, picture=found.picture, words=found.words, scale_source=found.scale_source, refused=camera.refused
        )
    # A camera that stands measures no lens.
    lens = camera.lens if camera.lens == "given" else "assumed" if kind is Kind.STANDS else "picture"
    return dataclasses.replace(found, lens=lens, refused=camera.refused)


def _solve(tracks: Tracks, keypoints: Keypoints2D, camera: CameraPath, settings: Settings) -> ImagePoses:
    """Poses in px by the method, with as much of the camera as it may see."""
    seen, adjuster = as_seen(camera), settings.adjuster
    if refinable(seen):
        first, final = (min(n, _STEPS_BEFORE_WORLD) for n in (adjuster.limb_iterations_first, adjuster.limb_iterations))
        adjuster = dataclasses.replace(adjuster, limb_iterations_first=first, limb_iterations=final)
    size = tracks.image_size
    view = None if by_place(camera) else person_view(keypoints, camera.matrix, seen.rotation, size)
    data = MethodInput(
        stamp_ns=tracks.stamp_ns,
        keypoints=keypoints if view is None else view.keypoints(keypoints),
        focal_px=camera.focal_px,
        initializer=settings.initializer,
        adjuster=adjuster,
        progress=settings.progress,
        rotation=seen.rotation if view is None else view.rotation(seen.rotation),
        pictures=tracks.real_lens,
    )
    if (evidence := body_evidence(tracks, len(settings.body))) is not None:
        about = view or person_view(keypoints, camera.matrix, None, size)  # taken as in the middle
        data = dataclasses.replace(data, evidence=evidence if about is None else evidence.turned(about.turn))
    poses = run_method(settings.method, data)
    if tracks.resting is not None:
        poses = dataclasses.replace(poses, still=_as_said(tracks.resting, poses.still))
    if not np.isfinite(poses.joints_px).all(axis=(1, 2)).any():
        raise InputError("keypoints: expected those of a person, got none that give a finite pose; check the values")
    if view is None:
        return poses
    # Else a body that leans may tell of a wrong pitch.
    if camera.points_tell_up and data.rotation is not None:
        poses = balanced(poses, data.rotation, tracks.stamp_ns)
    return view.in_image(poses)


def _as_said(resting: np.ndarray, still: np.ndarray | None) -> np.ndarray:
    """(F, 2) probability that a foot rests: as somebody says, else as the method does."""
    return np.where(np.isfinite(resting), resting, 0.5 if still is None else still)


class _Clock:
    """Seconds of the steps, for a motion's ``meta``."""

    def __init__(self) -> None:
        self._begin = self._last = time.perf_counter()
        self._steps: dict[str, float] = {}

    def lap(self, step: str, counts: object = True) -> None:
        """The time since the last lap was this step's, if it counts."""
        now = time.perf_counter()
        if counts:
            self._steps[step] = self._steps.get(step, 0.0) + now - self._last
        self._last = now

    def seconds(self, of_poses: dict[str, float]) -> dict[str, float]:
        """All steps, those of the method in the place of its own."""
        total = time.perf_counter() - self._begin
        steps = {**of_poses, **{name: took for name, took in self._steps.items() if name != "poses"}}
        return {**steps, "other": total - sum(steps.values()), "total": total}


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
