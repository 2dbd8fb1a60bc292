"""Live windows in the world: with the reported camera in ``map``, by fixed points alone in ``odom``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.contacts import ANKLES
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.reconstruction.camera.fusion import Fusion, with_measured
from drocap_ros.reconstruction.camera.upright import FEET_HZ, by_ground
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.lifted.method import WindowSolution
from drocap_ros.reconstruction.live.fused_camera import FusedCamera
from drocap_ros.reconstruction.live.window import AdjustedWindow, InMap, TelemetryUse, Window
from drocap_ros.reconstruction.live.world_chain import WorldChain
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.world.findings import Findings
from drocap_ros.reconstruction.world.in_world import in_camera_axes
from drocap_ros.reconstruction.world.placement import metres_per_px, place_in_world
from drocap_ros.reconstruction.world.refine import RefinedWorld
from drocap_ros.reconstruction.world.telemetry_checks import stopped, unchanged
from drocap_ros.reconstruction.world.world_model import config_of, world_config

#: Time (s) for which the newest images may lack a reported pose: states of the vehicle arrive later than images.
_LATE_S = 0.5
#: Shorter windows (s) determine nothing: they hold no two steps of walking.
_LEAST_S = 2.0


class WorldWindows:
    """Adjusts one window after the other.

    What the body found is forgotten with the subject, what fixed points found with the pass of time.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = world_config(config)
        self._length_ns = round(config.world_window_s * 1e9)
        self._subject: int | None = None
        self._newest_ns = 0
        self._chain, self._fused = WorldChain(), FusedCamera()
        self._moved = self._by_points = False
        #: Whether the last window's telemetry was true: the lifter may see the camera's rotation.
        self.trusted = False

    def adjust(self, w: Window, found: WindowSolution, camera_result: AdjustedWindow) -> AdjustedWindow:
        """The window's result in ``map``, or that in the camera's axes with the use of the telemetry.

        Parameters
        ----------
        w : its keypoints are NaN where not seen
        found : the window's poses in px
        camera_result : its result in camera axes
        """
        if w.subject != self._subject:
            self._subject, self._chain = w.subject, WorldChain()
        newest_ns = int(w.stamp_ns[-1])
        if newest_ns < self._newest_ns:
            self._fused = FusedCamera()
        self._newest_ns = newest_ns
        result = self._adjust(w, found, camera_result)
        self.trusted = result.telemetry in (TelemetryUse.USED, TelemetryUse.UNSCALED)
        return result

    def _adjust(self, w: Window, found: WindowSolution, camera_result: AdjustedWindow) -> AdjustedWindow:
        if w.camera is None or not w.camera.known.any():
            return camera_result
        use = self._frames(w)
        if use is None:
            return replace(camera_result, telemetry=TelemetryUse.LATE)
        height_m, w = w.height_m, w.frames(use)
        assert w.camera is not None
        camera, stamps = replace(w.camera, errors=self._config.errors), w.stamp_ns
        self._moved |= not unchanged(*camera.pose).all()
        if self._moved and (refusal := stopped(*camera.pose, stamps)):
            return self._refused(camera_result, refusal)
        poses = ImagePoses.centred(found.joints[use], sigma_px=found.sigma[use], still=found.still[use])
        refined = self._refined(camera, w, poses, height_m)
        if isinstance(refined, Refusal):
            return self._refused(camera_result, refined)
        if refined is None:
            return replace(camera_result, telemetry=TelemetryUse.LATE)
        if not refined.metric:
            return replace(camera_result, telemetry=TelemetryUse.UNSCALED)
        return replace(
            camera_result,
            stamp_ns=stamps,
            joints3d=refined.joints,
            covariance=refined.covariance,
            confidence=camera_result.confidence[use],
            reprojection_rms_px=camera_result.reprojection_rms_px[use],
            telemetry=TelemetryUse.USED,
            in_map=InMap(refined.rotation, refined.position, _correction(refined, camera)),
            calibration=str(self._fused.calibration) if self._by_points else "",
        )

    def _refined(
        self, camera: CameraPath, w: Window, poses: ImagePoses, height_m: float
    ) -> RefinedWorld | Refusal | None:
        """The window in the world, by its fixed points too where there are enough; None = too short."""
        stamps = camera.stamp_ns
        fused = self._fused.correct(camera, w.background)
        if isinstance(fused, Refusal):
            return fused
        if self._by_points != (fused is not None):  # the camera's reports have other errors now
            self._chain.of_scale(stamps)
            self._by_points = fused is not None
        per_px = metres_per_px(true_shape(poses.in_image, camera.matrix), stamps, height_m)
        config, extra = self._config, None
        if fused is not None:
            # Feet need not tell whether the reports are true: points have.
            camera, config, extra = fused.camera, replace(config, checks=False), _ground(fused, poses, per_px)
        config = self._chain.steps(config_of(camera, config), stamps)
        refined = self._chain.refined(camera, w.keypoints, poses, per_px, config, extra)
        return with_measured(refined, camera) if isinstance(refined, RefinedWorld) else refined

    def _refused(self, camera_result: AdjustedWindow, refusal: Refusal) -> AdjustedWindow:
        self._chain.begin()
        return replace(camera_result, telemetry=TelemetryUse.REFUSED, reason=str(refusal))

    def _frames(self, w: Window) -> slice | None:
        """The last seconds, as far as the camera is known all the time."""
        assert w.camera is not None
        runs = true_runs(w.camera.known)
        if not len(runs):
            return None
        begin, end = (int(i) for i in runs[-1])
        stamps = w.stamp_ns
        begin = max(begin, int(np.searchsorted(stamps, stamps[end - 1] - self._length_ns)))
        if stamps[-1] - stamps[end - 1] > _LATE_S * 1e9 or stamps[end - 1] - stamps[begin] < _LEAST_S * 1e9:
            return None
        return slice(begin, end)


def _ground(fused: Fusion, poses: ImagePoses, per_px: np.ndarray) -> Findings:
    """The scale at which feet stand on the plane of points.

    It errs alike in every window of a person, and is not carried on.
    """
    camera, path = fused.camera, fused.path
    here = replace(camera, position=np.zeros((len(camera.stamp_ns), 3)))
    seen = place_in_world(in_camera_axes(poses, per_px), poses.in_image[..., :2], per_px, here).joints
    slot, fps = even_slots(camera.stamp_ns)
    level = by_ground(np.array([0.0, 0.0, 1.0]), seen[:, ANKLES], path.position[slot], path.points)
    found = Findings.unknown()
    if level is not None:
        steps = max(FEET_HZ * len(path.position) / fps, 1.0)
        found.precision[0, 0] = 1.0 / (level.scale.std**2 + level.spread**2 / steps)
        found.vector[0] = np.log(level.scale.factor) * found.precision[0, 0]
    return found


def _correction(refined: RefinedWorld, camera: CameraPath) -> np.ndarray:
    rotation, position = camera.pose
    turned = refined.rotation[-1:] @ np.swapaxes(rotation[-1:], 1, 2)
    return np.concatenate([refined.position[-1] - position[-1], log_so3(turned)[0]])
