"""Live windows without telemetry: poses in ``odom``, where fixed points alone tell the camera's path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.geometry.ellipsoids import pack_covariance, unpack_covariance
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.lifted.method import WindowSolution
from drocap_ros.reconstruction.live.picture_odometry import Person, PictureOdometry, PicturePath, own_covariance
from drocap_ros.reconstruction.live.window import AdjustedWindow, InMap, Window
from drocap_ros.reconstruction.live.world_chain import WorldChain
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import place_in_world
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.world_model import world_config
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks


class PictureWindows:
    """Places one window after the other; the path is the scene's and outlives its subjects."""

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = world_config(config)
        self._length_ns = round(config.world_window_s * 1e9)
        self._odometry, self._chain = PictureOdometry(), WorldChain()
        self._of: tuple[int, int, int] | None = None  # subject, path and corrections of the chain

    def adjust(self, w: Window, found: WindowSolution, camera_result: AdjustedWindow) -> AdjustedWindow:
        """The window's result in ``odom``, or that in the camera's axes with the reason.

        The arguments are those of ``WorldWindows.adjust``.
        """
        if w.background is None:
            return camera_result
        if w.stamp_ns[-1] < self._odometry.since_ns:  # another pass of time
            self._odometry = PictureOdometry()
        newest_ns = int(w.stamp_ns[-1])
        use = slice(int(np.searchsorted(w.stamp_ns, max(newest_ns - self._length_ns, self._odometry.since_ns))), None)
        tracks = _tracks(w.frames(use))
        poses = ImagePoses.centred(found.joints[use], sigma_px=found.sigma[use], still=found.still[use])
        had = self._odometry.losses
        person = Person(poses, w.height_m, w.subject)
        path = self._odometry.follow(tracks, person, self._config)
        lost, why = self._odometry.losses > had, self._odometry.lost
        if path is None:
            return replace(camera_result, picture=why, lost=lost)
        of = w.subject, path.number, path.corrections
        if self._of != of:
            self._of, self._chain = of, WorldChain()
        placed = self._placed(path, person, w.keypoints[use], camera_result)
        return replace(placed, picture=f"{path.words}; {why}" if lost else path.words, lost=lost)

    def _placed(
        self, path: PicturePath, person: Person, keypoints: Keypoints2D, seen: AdjustedWindow
    ) -> AdjustedWindow:
        """The window's last images, those of the path, in ``odom``; ``seen`` : all of it in camera axes."""
        poses, tracks, config = person.poses, path.tracks, path.world.config
        use = slice(len(seen.stamp_ns) - len(keypoints), None)
        rotation, position = tracks.camera_rotation, tracks.camera_position
        assert rotation is not None
        assert position is not None
        per_px = person.metres_per_px(tracks)
        refined = None
        if config is not None:
            config = self._chain.steps(config, tracks.stamp_ns)
            refined = self._chain.refined(tracks, keypoints, poses, per_px, config)
        if isinstance(refined, RefinedWorld):
            joints, covariance = refined.joints, unpack_covariance(refined.covariance)
            rotation, position = refined.rotation, refined.position
        else:
            # Up is unsure: the body is as without a world, placed at its pelvis.
            placed = place_in_world(in_camera_axes(poses, per_px), poses.in_image[..., :2], per_px, tracks).joints
            joints = placed[:, :1] + seen.joints3d[use] @ rotation
            turned = rotation[:, None]
            covariance = np.swapaxes(turned, -1, -2) @ unpack_covariance(seen.covariance[use]) @ turned
        covariance = covariance + own_covariance(path, joints, self._config.stature_std)
        return replace(
            seen,
            stamp_ns=tracks.stamp_ns,
            joints3d=joints,
            covariance=pack_covariance(covariance),
            confidence=seen.confidence[use],
            reprojection_rms_px=seen.reprojection_rms_px[use],
            in_map=InMap(rotation, position, np.zeros(6), path.number),
        )


def _tracks(w: Window) -> Tracks:
    keypoints = w.keypoints
    return Tracks(
        keypoints=keypoints.xy,
        joints=BODY_17.joints,
        stamp_ns=w.stamp_ns,
        image_size=w.image_size,
        camera_matrix=None if w.camera is None else w.camera.matrix,
        background=w.background,
    )
