"""Offline reconstruction: 2D tracks to a motion by one of the methods."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np

from drocap_ros import __version__
from drocap_ros.errors import InputError
from drocap_ros.joint_maps import TABLES, joint_map, joint_set_of
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput, Progress
from drocap_ros.reconstruction.common.threads import blas_threads
from drocap_ros.reconstruction.heels import with_heels
from drocap_ros.reconstruction.lifted.lifted_config import lifted_config
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.method import ACROSS, ALONG
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.methods.run import run_method
from drocap_ros.reconstruction.paper.dictionary import REFERENCE_STATURE_M, Dictionary, load_dictionary
from drocap_ros.reconstruction.world.in_world import in_camera_axes, in_world
from drocap_ros.reconstruction.world.placement import metres_per_px
from drocap_ros.reconstruction.world.refine import refinable
from drocap_ros.reconstruction.world.world_model import WorldConfig, world_config
from drocap_ros.revision import git_revision
from drocap_ros.skeleton import BODY_15, BODY_17, BODY_19, JointSet, body_set
from drocap_ros.tracks import Tracks

#: Steps of each of the body's adjustments where the one in the world goes on from them: more change nothing there.
_STEPS_BEFORE_WORLD = 2


def reconstruct(
    tracks: Tracks,
    *,
    method: str = "ba",
    initializer: InitializerConfig | None = None,
    adjuster: BundleAdjusterConfig | None = None,
    dictionary: Dictionary | None = None,
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
    initializer = initializer or InitializerConfig()
    adjuster = adjuster or BundleAdjusterConfig()
    dictionary = dictionary or load_dictionary(initializer.dictionary or None)
    started = time.perf_counter()
    joints = METHODS[method].joints
    seen = body_keypoints(tracks, BODY_19)
    keypoints = seen.with_joints(len(joints))
    k = tracks.camera_matrix
    body = adjuster
    if refinable(tracks):
        first, final = (min(n, _STEPS_BEFORE_WORLD) for n in (adjuster.limb_iterations_first, adjuster.limb_iterations))
        body = dataclasses.replace(adjuster, limb_iterations_first=first, limb_iterations=final)
    data = MethodInput(
        stamp_ns=tracks.stamp_ns,
        keypoints=keypoints,
        focal_px=None if k is None else 0.5 * float(k[0, 0] + k[1, 1]),
        initializer=initializer,
        adjuster=body,
        dictionary=dictionary,
        progress=progress or (lambda stage, fraction: None),
        rotation=tracks.camera_rotation,
    )
    with blas_threads(adjuster.threads):
        result = run_method(method, data)
        if not np.isfinite(result.joints_px).all(axis=(1, 2)).any():
            raise InputError(
                "keypoints: expected those of a person, got none that give a finite pose; check the values"
            )
        solved = time.perf_counter()
        motion = _to_motion(tracks, joints, keypoints, result, initializer, world_config(adjuster))
    if isinstance(motion, str):
        # The lifter saw the camera's rotation: without it the poses differ too.
        without = dataclasses.replace(tracks, camera_rotation=None, camera_position=None)
        again = reconstruct(
            without, method=method, initializer=initializer, adjuster=adjuster, dictionary=dictionary, progress=progress
        )
        again.meta["telemetry_rejected"] = motion
        return again
    if joints is BODY_17:
        motion = with_heels(motion, seen.without_joints(len(joints)), _in_image(result))
    seconds = dict(result.seconds)
    if motion.frame == "world":
        seconds["world"] = time.perf_counter() - solved
    total = time.perf_counter() - started
    motion.meta.update(
        method=method,
        versions=_versions(),
        git_revision=git_revision(),
        parameters={"initializer": dataclasses.asdict(initializer), "adjuster": dataclasses.asdict(adjuster)},
        dictionary=dictionary.metadata,
        seconds={**seconds, "other": total - sum(seconds.values()), "total": total},
        iterations=result.iterations,
        stop_reason=result.stop_reason,
        cost_terms=result.cost_terms,
        frames=len(tracks),
    )
    if method == "ba":
        own = lifted_config(adjuster)
        motion.meta["parameters"]["default_method"] = dataclasses.asdict(own)
        motion.meta["parameters"]["world"] = dataclasses.asdict(world_config(adjuster))
        motion.meta["lifter"] = Lifter.load(own.lifter or None).origin
    return motion


def body_keypoints(tracks: Tracks, joints: JointSet = BODY_17) -> Keypoints2D:
    """Keypoints in the order of ``joints``, a body set; those that the tracks lack are NaN.

    Names of the body sets, COCO, COCO-WholeBody, Halpe, MPII and Human3.6M are known (:mod:`drocap_ros.joint_maps`).

    Raises
    ------
    InputError
        When the names give too few joints of BODY_15.
    """
    source, place = joint_set_of(tracks.joints)
    have = place >= 0
    names = tuple(np.array(source.joints)[have])
    given = sum(set(parts) <= set(names) for parts in TABLES[source.name].values())
    if given < 4:
        raise InputError(
            f"joints: expected at least 4 of {', '.join(BODY_15.joints)}, or names of {', '.join(list(TABLES)[3:])},"
            f" got {given} of them; rename the joints"
        )
    shape = (len(tracks), len(source))
    keypoints, confidence, covariance = np.full((*shape, 2), np.nan), np.zeros(shape), np.full((*shape, 3), np.nan)
    keypoints[:, have] = tracks.keypoints[:, place[have]]
    keypoints[np.isnan(keypoints).any(-1)] = np.nan
    if tracks.covariance is not None:
        covariance[:, have] = tracks.covariance[:, place[have]]
    seen = np.isfinite(keypoints).all(-1)
    confidence[:, have] = tracks.confidence[:, place[have]] if tracks.confidence is not None else seen[:, have]
    if not body_set(source):
        high, low = (np.where(seen[..., None], keypoints, end) for end in (-np.inf, np.inf))
        extent = np.where(seen.any(1), (high.max(1) - low.min(1)).max(1), 0.0)
        keypoints, covariance, confidence = joint_map(source.name).apply(keypoints, covariance, confidence, extent)
    elif tracks.confidence is None and tracks.covariance is None:
        return Keypoints2D(keypoints, None, None).with_joints(len(joints))
    found = Keypoints2D(keypoints, confidence, covariance if tracks.covariance is not None else None)
    return found.with_joints(len(joints))


def _to_motion(
    tracks: Tracks,
    body: JointSet,
    keypoints: Keypoints2D,
    result: CameraPoses,
    config: InitializerConfig,
    world_config: WorldConfig,
) -> Motion | str:
    """The motion, or in words why the telemetry cannot be true."""
    projected = result.joints_px[..., :2] + result.translation_px[:, None]
    reprojection = np.linalg.norm(projected - keypoints.xy, axis=-1)
    per_px = metres_per_px(result.joints_px, tracks.stamp_ns, config.assumed_height_m)
    joints = in_camera_axes(result, per_px)
    metric, scale_source = False, "assumed_height"
    meta: dict[str, Any] = {"assumed_height_m": config.assumed_height_m, "reference_stature_m": REFERENCE_STATURE_M}
    position = covariance = None
    rotation, frame = np.broadcast_to(np.eye(3), (len(tracks), 3, 3)).copy(), "camera"
    if tracks.camera_rotation is None and tracks.camera_matrix is not None:
        # Undo the perspective, as place_in_world: it moves joints behind the pelvis towards the axis.
        range_m = 0.5 * (tracks.camera_matrix[0, 0] + tracks.camera_matrix[1, 1]) * per_px
        joints[..., :2] *= np.maximum(1.0 + joints[..., 2] / range_m[:, None], 0.1)[..., None]
    if tracks.camera_rotation is not None:
        rotation, frame = tracks.camera_rotation, "world"
        world, found = in_world(tracks, keypoints, result, per_px, world_config)
        joints, metric, scale_source = world.joints, world.metric, world.scale_source
        if world.scale is not None:
            meta["scale"] = dataclasses.asdict(world.scale)
        position = tracks.camera_position
        if isinstance(found, str):
            return found
        if found is not None:
            joints, rotation, position, metric = found.joints, found.rotation, found.position, found.metric
            scale_source = "telemetry" if metric else "assumed_height"
            covariance = found.covariance
            reprojection = reprojection_px(joints, rotation, position, tracks.camera_matrix, keypoints.xy)
            meta["calibration"], meta["covariance_about"] = found.calibration, "origin"
    if covariance is None and result.sigma_px is not None:
        covariance = _covariance(result.sigma_px * per_px[:, None, None], rotation)
        meta["covariance_about"] = "pelvis"
    return Motion(
        joints3d=np.ascontiguousarray(joints),
        joints=body.joints,
        parents=body.parents,
        stamp_ns=tracks.stamp_ns,
        frame=frame,
        metric=metric,
        scale_source=scale_source,
        camera_rotation=rotation,
        confidence=keypoints.weights,
        keypoints=keypoints.xy,
        reprojection_px=reprojection,
        meta=meta,
        camera_position=position,
        covariance=covariance,
    )


def _covariance(sigma: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(F, P, 6) m^2 about the pelvis of expected errors (F, P, 2) m across and along the ray; world -> camera."""
    variance = np.square(sigma * np.array([ACROSS, ALONG]))[..., [0, 0, 1]]
    full = np.einsum("fki,fpk,fkj->fpij", rotation, variance, rotation)
    packed: np.ndarray = full[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return packed


def _in_image(result: CameraPoses) -> np.ndarray:
    """(F, P, 3) px, the method's joints, x and y in the image."""
    joints = result.joints_px.copy()
    joints[..., :2] += result.translation_px[:, None]
    return joints


def reprojection_px(
    joints: np.ndarray, rotation: np.ndarray, position: np.ndarray, matrix: np.ndarray | None, keypoints: np.ndarray
) -> np.ndarray:
    """(F, P) px, distance of joints in the world, as a camera there projects them, from keypoints; NaN = not seen."""
    assert matrix is not None
    seen = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    projected = seen[..., :2] / np.maximum(seen[..., 2:], 1e-3) * np.diagonal(matrix)[:2] + matrix[:2, 2]
    distance: np.ndarray = np.linalg.norm(projected - keypoints, axis=-1)
    return distance


def _versions() -> dict[str, str]:
    import platform

    return {"drocap_ros": __version__, "numpy": np.__version__, "python": platform.python_version()}
