"""A world without telemetry: the camera from the tracks' fixed points, upright and in metres by the body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.geometry.ellipsoids import pack_covariance
from drocap_ros.reconstruction.camera.from_picture import PictureCamera, camera_from_points
from drocap_ros.reconstruction.camera.fusion import with_camera_errors
from drocap_ros.reconstruction.camera.path_model import KNOTS_HZ
from drocap_ros.reconstruction.camera.upright import Upright, set_upright
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.world.even_capture import LEAST_FRAMES
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import place_in_world
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import WorldConfig
from drocap_ros.reconstruction.world.world_residuals import WANDER_S
from drocap_ros.tracks import Tracks

#: Errors of a path from fixed points, per track of which a hundred remain: constant ones have no place in it, as the
#: points turn with the camera; slow ones (`HELD_M`, `_ATTITUDE_DEG`) are at least these.
_TURNED_DEG = 0.02
_LATENCY_S = 1e-3
HELD_M = 0.02
_ATTITUDE_DEG = 0.05
#: Deviation (deg) of up below which the lifter sees it and the body is adjusted with it.  Ground under the feet
#: has 0.5, feet alone 3: with such an up the knees of a still camera's video were bent by 8 degrees more than without.
_SURE_UP_DEG = 2.0
#: Largest standard deviation of the logarithm of a path's scale, before body and camera are adjusted together.
_SCALE_STD = 0.3


@dataclass(frozen=True)
class PictureWorld:
    """What the picture tells of the camera.

    upright : its path in the world; None = the camera is not known
    config : of the adjustment of body and camera with it; None = up is unsure, and the body stays as it is seen
    errors : (F, 6, 6) covariance of its position (m) and rotation (rad) about the path's mean; None = unknown
    """

    camera: PictureCamera
    upright: Upright | None = None
    config: WorldConfig | None = None
    errors: np.ndarray | None = None

    def meta(self) -> dict[str, object]:
        """JSON-compatible: where the world comes from."""
        camera, upright = self.camera, self.upright
        found: dict[str, object] = {"kind": camera.kind.name.lower(), "words": camera.kind.value}
        if not camera.kind.known:
            return found
        focal = 0.5 * float(camera.matrix[0, 0] + camera.matrix[1, 1])
        found |= {
            "residual_px": _number(camera.residual_px),
            "covered": camera.covered,
            "focal_px": focal,
            "focal_std_px": _number(focal * camera.focal_std),
        }
        if upright is not None:
            found |= {
                "up": upright.source.name.lower(),
                "up_words": upright.source.value,
                "up_std_deg": upright.std_deg,
                "scale_std": _number(upright.scale_std),
            }
        return found


def picture_camera(tracks: Tracks) -> PictureCamera | None:
    """The camera of tracks with fixed points and without telemetry; None for others and for too short ones."""
    points = tracks.background
    if points is None or tracks.camera_rotation is not None or len(tracks) < LEAST_FRAMES:
        return None
    slot, fps = even_slots(tracks.stamp_ns)
    camera = camera_from_points(
        slot[points.frame],
        points.track,
        points.point.astype(np.float64),
        fps,
        int(slot[-1]) + 1,
        tracks.image_size,
        tracks.camera_matrix,
    )
    drift = None if camera.drift is None else camera.drift[slot]
    return replace(camera, rotation=camera.rotation[slot], position=camera.position[slot], drift=drift)


def with_camera(
    tracks: Tracks, camera: PictureCamera, poses: ImagePoses, per_px: np.ndarray, config: WorldConfig
) -> tuple[Tracks, PictureWorld]:
    """The tracks with the camera's path in the world: metres and up by poses at (F,) metres per px."""
    seen = seen_from_camera(tracks, poses, per_px)
    upright = set_upright(camera.rotation, camera.position, camera.points, seen, tracks.stamp_ns)
    world = replace(tracks, camera_rotation=upright.rotation, camera_position=upright.position)
    # What feet have measured the adjustment measures better, from the same feet: no prior counts them twice.
    scale_std = _SCALE_STD if upright.feet_tell else min(upright.scale_std, _SCALE_STD)
    # Steps of the path err independently and add up to an error that wanders: resting feet and the body's size tell it.
    step_m = float(np.nan_to_num(metres_per_unit(camera, upright.position) * camera.position_std))
    wander_m = step_m * float(np.sqrt(0.5 * KNOTS_HZ * WANDER_S[0]))
    config = replace(
        config,
        stature_std=scale_std if np.isfinite(upright.scale_std) else config.stature_std,
        tilt_error_deg=_TURNED_DEG,
        yaw_error_deg=_TURNED_DEG,
        latency_std_s=_LATENCY_S,
        position_wander_m=max(HELD_M, wander_m),
        attitude_wander_deg=_ATTITUDE_DEG,
        checks=False,
        corrected=True,
    )
    sure = upright.std_deg < _SURE_UP_DEG
    return world, PictureWorld(camera, upright, config if sure else None, _errors(camera, upright.position))


def metres_per_unit(camera: PictureCamera, position: np.ndarray) -> float:
    """Metres per unit of a camera's path, which is known in metres (F, 3) as well."""
    way_m, way = (float(np.linalg.norm(np.ptp(path, axis=0))) for path in (position, camera.position))
    return way_m / max(way, 1e-9)


def _errors(camera: PictureCamera, position: np.ndarray) -> np.ndarray | None:
    """(F, 6, 6) covariance of a camera's position (m) and rotation (rad), whose path (F, 3) m is known."""
    if camera.drift is None:
        return None
    std = camera.drift * [metres_per_unit(camera, position), 1.0]
    return np.asarray(np.eye(6) * np.square(np.repeat(std, 3, axis=1))[:, None])


def seen_from_camera(tracks: Tracks, poses: ImagePoses, per_px: np.ndarray) -> np.ndarray:
    """(F, P, 3) m, joints from the camera, in its axes, at (F,) metres per px."""
    frames = len(tracks)
    still = replace(tracks, camera_rotation=np.tile(np.eye(3), (frames, 1, 1)), camera_position=np.zeros((frames, 3)))
    projected = poses.joints_px[..., :2] + poses.translation_px[:, None]
    return place_in_world(in_camera_axes(poses, per_px), projected, per_px, still).joints


def at_assumed_stature(refined: RefinedWorld, world: PictureWorld, stature_std: float) -> RefinedWorld:
    """The world with the body at its assumed stature: nothing else gives a path of the picture its metres.

    Its joints are as uncertain, about their mean place, as path and stature (relative deviation) make them, too.
    """
    scale = float(np.median([window["scale"] for window in refined.calibration]))
    if world.errors is not None:
        refined = with_camera_errors(refined, world.errors)
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


def _number(value: float) -> float | None:
    """A number for JSON, which knows no NaN."""
    return value if np.isfinite(value) else None
