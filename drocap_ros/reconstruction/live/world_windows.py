"""Live windows in the world: with the reported camera in ``map``, by fixed points alone in ``odom``."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.contacts import ANKLES
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.geometry.rotations import exp_so3, log_so3, project_to_so3
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry, with_measured
from drocap_ros.reconstruction.camera.path_model import ATTITUDE_LATENCY, MISALIGNMENT, POSITION_LATENCY
from drocap_ros.reconstruction.camera.path_residuals import expected_shared
from drocap_ros.reconstruction.camera.upright import FEET_HZ, by_ground
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.refusal import Refusal, Why
from drocap_ros.reconstruction.common.windows import even_slots
from drocap_ros.reconstruction.lifted.method import WindowSolution
from drocap_ros.reconstruction.live.window import AdjustedWindow, InMap, Retry, TelemetryUse, Window
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry, at_other_time
from drocap_ros.reconstruction.world.even_capture import at_all_slots
from drocap_ros.reconstruction.world.in_world import in_camera_axes, in_world
from drocap_ros.reconstruction.world.placement import metres_per_px, place_in_world
from drocap_ros.reconstruction.world.refine import Before, RefinedWorld
from drocap_ros.reconstruction.world.telemetry_checks import stopped, unchanged
from drocap_ros.reconstruction.world.world_model import Findings, WorldConfig, config_of, world_config

#: Share of a recording's steps that lock feet, and of all steps of a window that continues another, as its inverse:
#: what more steps would change, the next window does, half a second later.
_FEWER_STEPS = 2


class _Last(NamedTuple):
    """The window before, what it found, and the camera that its adjustment was given."""

    before: Before
    found: Findings
    camera: CameraPath


class WorldChain:
    """What the last window and all before it found; memory is that of a window."""

    def __init__(self) -> None:
        self._known = Findings.unknown()
        self._last: _Last | None = None

    def begin(self) -> None:
        """The next window continues none; what was found stays known."""
        self._last = None

    def of_scale(self, stamp_ns: np.ndarray) -> None:
        """The next window, of these stamps, has another source of the camera: the scale alone stays known."""
        self._known, self._last = self._prior(stamp_ns).of_scale(), None

    def move(self, by: np.ndarray) -> None:
        """The last window lies (3,) m beside where it was, and the next one continues it there."""
        if self._last is not None:
            before, found, camera = self._last
            there = replace(camera, position=camera.pose[1] + by)
            self._last = _Last(before._replace(joints=before.joints + by), found, there)

    def steps(self, config: WorldConfig, stamp_ns: np.ndarray) -> WorldConfig:
        """The configuration with the steps of a window of these stamps."""
        config = replace(config, locking_iterations=config.locking_iterations // _FEWER_STEPS)
        return (
            config
            if self._continued(stamp_ns) is None
            else replace(config, iterations=config.iterations // _FEWER_STEPS)
        )

    def refined(
        self,
        camera: CameraPath,
        keypoints: Keypoints2D,
        poses: ImagePoses,
        per_px: np.ndarray,
        config: WorldConfig,
        extra: Findings | None = None,
    ) -> RefinedWorld | Refusal | None:
        """The next window in the world; None = too short.  ``extra`` : priors of this window alone."""
        known = self._prior(camera.stamp_ns)
        every = known if extra is None else known.later(extra, 1.0, 0.0)
        _, found = in_world(camera, keypoints, poses, per_px, config, every, self._before_in(camera))
        if isinstance(found, RefinedWorld):
            self._known, self._last = known, _Last(found.before, found.found, camera)
        return found

    def _continued(self, stamps: np.ndarray) -> _Last | None:
        """The window before, where the window of these stamps shares frames with it."""
        return None if self._last is None or stamps[0] > self._last.before.stamp_ns[-1] else self._last

    def _prior(self, stamps: np.ndarray) -> Findings:
        """Findings of earlier windows that the window of these stamps has not itself."""
        return (
            self._known
            if self._last is None
            else self._known.after(self._last.found, self._last.before.stamp_ns, stamps)
        )

    def _before_in(self, camera: CameraPath) -> Before | None:
        """The window that this one continues, with its slow errors as those of this camera."""
        last = self._continued(camera.stamp_ns)
        if last is None:
            return None
        before = last.before
        wander = before.wander.copy()
        at, here = (np.isin(a, b) for a, b in itertools.permutations((before.stamp_ns, camera.stamp_ns)))
        (turn, place), (their_turn, their_place) = camera.pose, last.camera.pose
        wander[at, :3] += their_place[at] - place[here]
        wander[at, 3:] += log_so3(their_turn[at] @ np.swapaxes(turn[here], 1, 2))
        return before._replace(wander=wander)


class Calibration(NamedTuple):
    """Constant errors of the reports as all windows until now tell them; mean (SHARED,) and covariance.

    axes : (3, 3) of the gimbal, rows in camera axes
    """

    mean: np.ndarray
    covariance: np.ndarray
    axes: np.ndarray

    @property
    def gimbal_deg(self) -> np.ndarray:
        """(3,) pitch, yaw, roll."""
        return np.asarray(np.degrees(self.axes @ self.mean[MISALIGNMENT]))

    def __str__(self) -> str:
        pitch, yaw, roll = self.gimbal_deg
        turned = self.axes @ self.covariance[MISALIGNMENT, MISALIGNMENT] @ self.axes.T
        std, late_std = np.degrees(np.sqrt(np.diag(turned))), np.sqrt(np.diag(self.covariance))
        attitude, position = -self.mean[[ATTITUDE_LATENCY, POSITION_LATENCY]]
        return (
            f"pitch {pitch:+.2f} ± {std[0]:.2f}, yaw {yaw:+.2f} ± {std[1]:.2f}, roll {roll:+.2f} ± {std[2]:.2f} deg;"
            f" late by {attitude:.3f} ± {late_std[ATTITUDE_LATENCY]:.3f} s (attitude),"
            f" {position:.3f} ± {late_std[POSITION_LATENCY]:.3f} s (position)"
        )


class FusedCamera:
    """Corrects one window's reports after the other; memory is that of a window."""

    def __init__(self) -> None:
        self._known = Findings.unknown()
        #: Images (F,) of the last window, and the findings of their points.
        self._last: tuple[np.ndarray, Findings] | None = None
        self.calibration: Calibration | None = None
        #: Why points refuse the reports, and when they are asked again: that takes as long as some adjustments.
        self._refusal: Refusal | None = None
        self._retry = Retry()
        #: The largest errors (deg, m, deg) that points have shown, which later windows expect from the start.
        self._shown: np.ndarray = np.zeros(3)

    def correct(self, camera: CameraPath, points: Background | None) -> Fusion | Refusal | None:
        """The window's camera corrected; the answers are those of ``fuse_telemetry``."""
        if points is None:
            return None
        assert camera.errors is not None
        (rotation, position), (tilt_deg, place_m, turn_deg), stamp_ns = camera.pose, self._shown, camera.stamp_ns
        newest_ns = int(stamp_ns[-1])
        if self._refusal is not None and not self._retry.due(newest_ns):
            return self._refusal
        known = self._known if self._last is None else self._known.after(self._last[1], self._last[0], stamp_ns)
        errors = replace(
            camera.errors,
            tilt_deg=max(camera.errors.tilt_deg, float(tilt_deg)),
            position_wander_m=max(camera.errors.position_wander_m, float(place_m)),
            attitude_wander_deg=max(camera.errors.attitude_wander_deg, float(turn_deg)),
        )
        slot, fps = even_slots(stamp_ns)
        rotation, position = project_to_so3(at_all_slots(rotation, slot)), at_all_slots(position, slot)
        given = CameraTelemetry(rotation, position, fps)
        before = known.precision + expected_shared(errors, given.gimbal_axes())
        mean = _inverse(before) @ known.vector
        later = at_other_time(given, *mean[[ATTITUDE_LATENCY, POSITION_LATENCY]].tolist())
        turned = exp_so3(mean[None, MISALIGNMENT]) @ later.rotation
        without = replace(camera.moved(turned[slot], later.position[slot]), errors=errors)
        fused = fuse_telemetry(without, points, known.precision)
        self._refusal = None
        if isinstance(fused, Refusal) and fused.why in (Why.POINTS_MOVE_OTHERWISE, Why.POINTS_TURN_OTHERWISE):
            self._retry.failed(newest_ns)
            self._refusal = replace(fused, again_s=self._retry.last_s)
            return self._refusal
        if isinstance(fused, Refusal) or fused is None:
            return fused
        self._retry = Retry()
        precision, vector = fused.path.facts
        self._known = known
        self._last = stamp_ns, Findings(precision, vector + precision @ mean)
        self.calibration = Calibration(mean + fused.path.shared, _inverse(before + precision), given.gimbal_axes())
        tilt = self.calibration.gimbal_deg[[0, 2]]
        self._shown = np.maximum(self._shown, (0.5 * np.abs(tilt).max(), *fused.wander))
        return fused


def _inverse(precision: np.ndarray) -> np.ndarray:
    """Inverse (SHARED, SHARED) among the unknowns of which something is known, zeros elsewhere."""
    some = np.ix_(*2 * (np.diag(precision) > 0.0,))
    inverse = np.zeros_like(precision)
    inverse[some] = np.linalg.inv(precision[some])
    return inverse


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
