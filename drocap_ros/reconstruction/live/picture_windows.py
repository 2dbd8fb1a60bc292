"""Live windows without telemetry: poses in ``odom``, where fixed points alone tell the camera's path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.rotations import exp_so3, pack_covariance, unpack_covariance
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.camera.growth import LEAST_POINTS
from drocap_ros.reconstruction.camera.path_model import LEAST_VIEWS
from drocap_ros.reconstruction.camera.picture_world import seen_from_camera
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.lifted.method import WindowSolution
from drocap_ros.reconstruction.live.picture_odometry import (
    Held,
    Person,
    PictureOdometry,
    PicturePath,
    camera_there,
    own_covariance,
)
from drocap_ros.reconstruction.live.window import AdjustedWindow, InMap, Window
from drocap_ros.reconstruction.live.world_windows import WorldChain
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import place_in_world
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import config_of, world_config
from drocap_ros.skeleton import BODY_17, indices

#: Time (s) at a window's end in which the person's place there is compared with that in another one.
_NEWEST_S = 1.5
#: Time (s) in which a person's speed is forgotten: that of people who walk and stand is to 0.4 the same after 2.5 s.
_SPEED_S = 3.0
_SIDES = indices(BODY_17.joints, ("rhip", "lhip", "rshoulder", "lshoulder"))


class PictureWindows:
    """Places one window after the other; the path is the scene's and outlives its subjects."""

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = world_config(config)
        self._length_ns = round(config.world_window_s * 1e9)
        self._odometry, self._chain = PictureOdometry(), WorldChain()
        self._of: tuple[int, int, int] | None = None  # subject, path and corrections of the chain
        self._last: tuple[AdjustedWindow, CameraPath] | None = None  # in `odom`, with its path

    def adjust(self, w: Window, found: WindowSolution, camera_result: AdjustedWindow) -> AdjustedWindow:
        """The window's result in ``odom``, or that in the camera's axes with the reason.

        The arguments are those of ``WorldWindows.adjust``.
        """
        if w.background is None:
            return camera_result
        if w.stamp_ns[-1] < self._odometry.since_ns:  # another pass of time
            self._odometry, self._last = PictureOdometry(), None
        since_ns = max(int(w.stamp_ns[-1]) - self._length_ns, self._odometry.since_ns)
        first = int(np.searchsorted(w.stamp_ns, since_ns))
        # The images after the last one with points have no camera yet: a later window may give them one.
        seeing = np.flatnonzero(np.bincount(w.background.frame) >= LEAST_POINTS)
        use = slice(first, seeing[-1] + 1 if len(seeing) else len(w.stamp_ns))
        if use.stop - first < LEAST_VIEWS:
            return replace(camera_result, picture=self._odometry.lost)
        poses = ImagePoses.centred(found.joints[use], sigma_px=found.sigma[use], still=found.still[use])
        had = self._odometry.losses
        person = Person(poses, w.height_m, w.subject)
        path = self._odometry.follow(w.frames(use), person)
        lost, why = self._odometry.losses > had, self._odometry.lost
        if path is None:
            return replace(camera_result, picture=why, lost=lost)
        of, before, last = (w.subject, path.number, path.corrections), self._of, self._last
        same = before is not None and before[0] == w.subject
        if before != of:
            self._of, self._chain = of, WorldChain()
        if last is not None and before is not None and before[1:] != of[1:]:
            path = self._odometry.moved(*_onward(*last, path.camera, person if same else None))
        placed = self._placed(path, person, w.keypoints[use], camera_result, use)
        if last is not None and same and before != of:
            # A path begins or is corrected about the person, whom both windows see.
            by = _beside(last[0], placed)
            path = self._odometry.moved(np.eye(3), by)
            self._chain.move(by)
            assert placed.in_map is not None
            there = placed.in_map._replace(position=placed.in_map.position + by)
            placed = replace(placed, joints3d=placed.joints3d + by, in_map=there)
        self._last = placed, path.camera
        return replace(placed, picture=f"{path.words}; {why}" if lost else path.words, lost=lost)

    def _placed(
        self, path: PicturePath, person: Person, keypoints: Keypoints2D, seen: AdjustedWindow, use: slice
    ) -> AdjustedWindow:
        """The window's images ``use``, those of the path, in ``odom``; ``seen`` : all of it in camera axes."""
        poses, camera = person.poses, path.camera
        rotation, position = camera.pose
        per_px = person.metres_per_px(camera)
        refined = None
        if camera.upright:
            config = self._chain.steps(config_of(camera, self._config), camera.stamp_ns)
            refined = self._chain.refined(camera, keypoints, poses, per_px, config)
        if isinstance(refined, RefinedWorld):
            joints, covariance = refined.joints, unpack_covariance(refined.covariance)
            rotation, position = refined.rotation, refined.position
        else:
            # Up is unsure: the body is as without a world, placed at its pelvis.
            placed = place_in_world(in_camera_axes(poses, per_px), poses.in_image[..., :2], per_px, camera).joints
            joints = placed[:, :1] + seen.joints3d[use] @ rotation
            turned = rotation[:, None]
            covariance = np.swapaxes(turned, -1, -2) @ unpack_covariance(seen.covariance[use]) @ turned
        covariance = covariance + own_covariance(path, joints, self._config.stature_std)
        return replace(
            seen,
            stamp_ns=camera.stamp_ns,
            joints3d=joints,
            covariance=pack_covariance(covariance),
            confidence=seen.confidence[use],
            reprojection_rms_px=seen.reprojection_rms_px[use],
            in_map=InMap(rotation, position, np.zeros(6), path.number),
        )


def _onward(
    last: AdjustedWindow, theirs: CameraPath, ours: CameraPath, same: Person | None
) -> tuple[np.ndarray, np.ndarray]:
    """Turn (3, 3) about the vertical and way (3,) m across it, by which a path goes on from the last window's.

    In the images of both the camera is where it was.  Where there are none, the ``same`` person faces as before, and
    the camera begins where the other path ended.
    """
    (rotation, position), both = ours.pose, camera_there(theirs, ours.stamp_ns)
    shared = len(both.image) > 0
    if not shared:
        both = Held(np.zeros(1, int), *(values[-1:] for values in theirs.pose))
    turned = np.einsum("fki,fkj->ij", both.rotation, rotation[both.image])
    yaw = float(np.arctan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1]))
    if same is not None and not shared:
        newest = last.stamp_ns >= last.stamp_ns[-1] - round(_NEWEST_S * 1e9)
        oldest = ours.stamp_ns <= ours.stamp_ns[0] + round(_NEWEST_S * 1e9)
        seen = seen_from_camera(ours, same.poses, same.metres_per_px(ours)) @ rotation
        yaw = np.deg2rad(_facing_deg(last.joints3d[newest]) - _facing_deg(seen[oldest][::-1]))
    about = exp_so3(np.array([0.0, 0.0, yaw]))
    return about, (both.position - position[both.image] @ about.T).mean(axis=0) * [1.0, 1.0, 0.0]


def _facing_deg(body: np.ndarray) -> float:
    """Where the left sides of hips and shoulders of poses (F, 17, 3) point at last, deg.

    By a straight line through all poses: one who moves his arms twists his trunk to and fro.
    """
    sides = body[:, _SIDES, :2]
    across = sides[:, [1, 3]].sum(axis=1) - sides[:, [0, 2]].sum(axis=1)
    angle = np.degrees(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))
    return float(np.polyfit(np.arange(len(angle)) - len(angle) + 1.0, angle, 1)[1])


def _beside(last: AdjustedWindow, placed: AdjustedWindow) -> np.ndarray:
    """(3,) m across the vertical from a window's person to where the last window has the same person.

    In the newest images of the last window that both have; where there are none, the person has gone on for a while.
    """
    theirs_s, ours_s = ((stamps - last.stamp_ns[-1]) * 1e-9 for stamps in (last.stamp_ns, placed.stamp_ns))
    late, both = theirs_s >= -_NEWEST_S, (ours_s >= -_NEWEST_S) & (ours_s <= 0.0)
    speed, place = np.polyfit(theirs_s[late], last.joints3d[late, 0, :2], 1)
    passed_s = ours_s[both] if both.any() else _SPEED_S * (1.0 - np.exp(-ours_s[:1] / _SPEED_S))
    ours = placed.joints3d[both if both.any() else slice(1), 0, :2]
    return np.append((place + passed_s[:, None] * speed - ours).mean(axis=0), 0.0)
