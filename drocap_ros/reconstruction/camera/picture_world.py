"""A world without telemetry: the camera from fixed points, upright and in metres by the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraErrors, CameraPath, Kind, PictureFacts, Teller, UpSource
from drocap_ros.contacts import ANKLE_M, ANKLES
from drocap_ros.geometry.rotations import centred_camera, pack_covariance
from drocap_ros.reconstruction.camera.from_picture import FOCAL_SHARE, camera_from_points
from drocap_ros.reconstruction.camera.path_model import KNOTS_HZ, LEFT
from drocap_ros.reconstruction.camera.upright import set_upright
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.windows import even_slots
from drocap_ros.reconstruction.world.even_capture import LEAST_FRAMES
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import place_in_world, smooth_over_time
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import GROUND_M, SIZE_STD

#: Least slow error (m) of the place of a path from fixed points, per track of which a hundred remain.
HELD_M = 0.02
#: Largest standard deviation of the logarithm of a path's scale, before body and camera are adjusted together.
_SCALE_STD = 0.3


def picture_camera(camera: CameraPath, points: Background | None, size: tuple[int, int]) -> CameraPath | None:
    """The camera of images of ``size`` by their fixed points, in a unit and axes of its own.

    None where nothing tells it.  An attitude without a place tells up; where no points say more, one that stays stands.
    """
    if len(camera.stamp_ns) < LEAST_FRAMES:
        return None
    attitude = camera.rotation
    found = None if points is None else _by_points(camera, points, size)
    if attitude is None or (found is not None and found.picture is not None and found.picture.kind.known):
        return found if attitude is None or found is None else with_told(found, attitude, camera.errors)
    if not np.allclose(attitude, attitude[0]):
        return None
    matrix = centred_camera(size, FOCAL_SHARE * max(size)) if camera.matrix is None else camera.matrix
    stands = PictureFacts(Kind.STANDS, residual_px=0.0, covered=1.0)
    still = camera.moved(np.broadcast_to(np.eye(3), attitude.shape), np.zeros((len(attitude), 3)))
    still = replace(
        still, teller=Teller.PICTURE, metric=False, scale_source="assumed_height", picture=stands, matrix=matrix
    )
    return with_told(still, attitude, camera.errors)


def with_told(found: CameraPath, attitude: np.ndarray, errors: CameraErrors | None) -> CameraPath:
    """The picture's camera with what its attitude (F, 3, 3) world -> camera, known to ``errors``, tells of up."""
    assert found.rotation is not None
    assert found.picture is not None
    up = np.einsum("fji,fj->i", found.rotation, attitude[:, :, 2])
    # An attitude that is told is known to a degree at best: a person reads it off a tripod, or a phone.
    std_deg = max((errors or CameraErrors()).tilt_deg, 1.0)
    picture = replace(found.picture, told=up / np.linalg.norm(up), told_std_deg=std_deg)
    return replace(found, picture=picture)


def with_vertical(found: CameraPath, vertical: np.ndarray | None) -> CameraPath:
    """The picture's camera with the ends px of what is vertical in its images: (N, 5), index, lower and upper end."""
    if vertical is None or found.matrix is None or found.rotation is None or found.picture is None:
        return found
    matrix = found.matrix
    ray = (vertical[:, 1:].reshape(-1, 2, 2) - matrix[:2, 2]) / np.diagonal(matrix)[:2]
    lower, upper = np.moveaxis(np.concatenate([ray, np.ones((*ray.shape[:2], 1))], axis=2), 1, 0)
    normal = np.cross(lower, upper)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    turned = np.einsum("nji,nj->ni", found.rotation[vertical[:, 0].astype(int)], normal)
    return replace(found, picture=replace(found.picture, lines=turned))


def _by_points(camera: CameraPath, points: Background, size: tuple[int, int]) -> CameraPath:
    slot, fps = even_slots(camera.stamp_ns)
    seen = slot[points.frame], points.track, points.point.astype(np.float64)
    found = camera_from_points(*seen, fps, int(slot[-1]) + 1, size, camera.matrix)
    facts = found.picture
    assert facts is not None
    picture = replace(facts, drift=None if facts.drift is None else facts.drift[slot])
    words = picture.meta(found.matrix)
    return replace(found.of_images(slot), stamp_ns=camera.stamp_ns, picture=picture, words=words)


def with_camera(camera: CameraPath, poses: ImagePoses, per_px: np.ndarray) -> CameraPath:
    """The picture's camera in the world: metres and up by poses at (F,) metres per px."""
    raw = camera.picture
    assert raw is not None
    world = set_upright(camera, seen_from_camera(camera, poses, per_px))
    facts, (_, position) = world.picture, world.pose
    assert facts is not None
    # What feet have measured the adjustment measures better, from the same feet: no prior counts them twice.
    scale_std = _SCALE_STD if facts.feet_tell else min(facts.scale_std, _SCALE_STD)
    # Steps of the path err independently and add up to an error that wanders: resting feet and the body's size tell it.
    errors = replace(LEFT, tilt_deg=max(facts.up_std_deg, LEFT.tilt_deg))
    step_m = float(np.nan_to_num(metres_per_unit(camera, position) * raw.position_std))
    wander_m = step_m * float(np.sqrt(0.5 * KNOTS_HZ * errors.position_wander_s))
    errors = replace(errors, position_wander_m=max(HELD_M, wander_m))
    found = replace(world, errors=errors, up_std_deg=facts.up_std_deg)
    return replace(
        found,
        covariance=_covariance(camera, position),
        scale_std=scale_std if np.isfinite(facts.scale_std) else None,
        corrected=True,
        points_tell_up=found.upright and facts.up is UpSource.GROUND,
        words=facts.meta(world.matrix),
    )


def metres_per_unit(camera: CameraPath, position: np.ndarray) -> float:
    """Metres per unit of a camera's path, which is known in metres (F, 3) as well."""
    way_m, way = (float(np.linalg.norm(np.ptp(path, axis=0))) for path in (position, camera.pose[1]))
    return way_m / max(way, 1e-9)


def _covariance(camera: CameraPath, position: np.ndarray) -> np.ndarray | None:
    """(F, 6, 6) of a camera's position (m) and rotation (rad), whose path (F, 3) m is known; None = unknown."""
    if camera.picture is None or camera.picture.drift is None:
        return None
    std = camera.picture.drift * [metres_per_unit(camera, position), 1.0]
    return np.asarray(np.eye(6) * np.square(np.repeat(std, 3, axis=1))[:, None])


def seen_from_camera(camera: CameraPath, poses: ImagePoses, per_px: np.ndarray) -> np.ndarray:
    """(F, P, 3) m, joints from the camera, in its axes, at (F,) metres per px."""
    frames = len(camera.stamp_ns)
    still = camera.moved(np.tile(np.eye(3), (frames, 1, 1)), np.zeros((frames, 3)))
    return place_in_world(in_camera_axes(poses, per_px), poses.in_image[..., :2], per_px, still).joints


def on_ground(camera: CameraPath, poses: ImagePoses, per_px: np.ndarray) -> np.ndarray:
    """(F,) metres per px at which the lower foot stands on the ground's points, z = 0, weighed with those by size."""
    rotation, position = camera.pose
    lower = (seen_from_camera(camera, poses, per_px) @ rotation)[:, ANKLES, 2].min(axis=1)
    above = np.maximum(position[:, 2], GROUND_M)
    fits = (lower < -ANKLE_M) & np.isfinite(lower)
    off = np.log(np.where(fits, above / np.maximum(ANKLE_M - lower, GROUND_M), 1.0))
    share = SIZE_STD**2 / (SIZE_STD**2 + np.square(GROUND_M / above))
    # Within half a second feet that stand and swing are one height.
    nearer = share * smooth_over_time(off, camera.stamp_ns, 0.5)
    return np.asarray(per_px * np.exp(nearer - np.median(nearer)))  # the body keeps its size: metres are the path's


def at_assumed_stature(refined: RefinedWorld, stature_std: float) -> RefinedWorld:
    """The world with the body at its assumed stature: nothing else gives a path of the picture its metres.

    Its joints are as uncertain, about their mean place, as the stature (relative deviation) makes them, too.
    """
    scale = float(np.median([window["scale"] for window in refined.calibration]))
    arm = refined.joints - np.nanmean(refined.joints, axis=(0, 1))
    by_stature = pack_covariance(stature_std**2 * arm[..., :, None] * arm[..., None, :])
    return replace(
        refined,
        joints=refined.joints / scale,
        position=refined.position / scale,
        place=refined.place / scale**2,
        covariance=(refined.covariance + by_stature) / scale**2,
        metric=False,
    )
