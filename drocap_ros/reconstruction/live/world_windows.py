"""Live windows in the world: the adjustment of ``world/``, with its findings as the prior of the next window.

A frame's information counts once: a window hands on its share of the frames that the next one has no longer.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drocap_ros.geometry.bones import LIMBS_PER_STATURE, limb_lengths
from drocap_ros.geometry.camera_history import WindowCamera
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import ImagePoses
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.lifted.method import WindowSolution
from drocap_ros.reconstruction.live.window import AdjustedWindow, InMap, TelemetryUse, Window
from drocap_ros.reconstruction.person_view import true_shape
from drocap_ros.reconstruction.world.findings import Findings
from drocap_ros.reconstruction.world.in_world import in_world
from drocap_ros.reconstruction.world.placement import metres_per_px
from drocap_ros.reconstruction.world.refine import Before, RefinedWorld
from drocap_ros.reconstruction.world.telemetry_checks import stopped, unchanged
from drocap_ros.reconstruction.world.world_model import world_config
from drocap_ros.skeleton import BODY_17
from drocap_ros.tracks import Tracks

#: Share of a recording's steps that lock feet, and of all steps of a window that continues another, as its inverse:
#: what more steps would change, the next window does, half a second later.
_FEWER_STEPS = 2
#: Time (s) for which the newest images may lack a reported pose: states of the vehicle arrive later than images.
_LATE_S = 0.5
#: Shorter windows (s) determine nothing: they hold no two steps of walking.
_LEAST_S = 2.0


class WorldWindows:
    """Adjusts one window after the other; what was found out is forgotten with the subject."""

    def __init__(self, config: BundleAdjusterConfig) -> None:
        first = world_config(config)
        self._first = replace(first, locking_iterations=first.locking_iterations // _FEWER_STEPS)
        self._next = replace(self._first, iterations=first.iterations // _FEWER_STEPS)
        self._length_ns = round(config.world_window_s * 1e9)
        self._subject: int | None = None
        self._known = Findings.unknown()
        #: The window before and its findings.
        self._before: tuple[Before, Findings] | None = None
        self._moved = False
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
            self._subject, self._known, self._before = w.subject, Findings.unknown(), None
        result = self._adjust(w, found, camera_result)
        self.trusted = result.telemetry in (TelemetryUse.USED, TelemetryUse.UNSCALED)
        return result

    def _adjust(self, w: Window, found: WindowSolution, camera_result: AdjustedWindow) -> AdjustedWindow:
        if w.camera is None or not w.camera.known.any():
            return camera_result
        use = self._frames(w)
        if use is None:
            return replace(camera_result, telemetry=TelemetryUse.LATE)
        camera, stamps, keypoints = w.camera.frames(use), w.stamp_ns[use], w.keypoints[use]
        self._moved |= not unchanged(camera.rotation, camera.position).all()
        if self._moved and (refusal := stopped(camera.rotation, camera.position, stamps)):
            return self._refused(camera_result, refusal)
        tracks = _tracks(stamps, keypoints, camera)
        poses = ImagePoses.centred(found.joints[use], sigma_px=found.sigma[use], still=found.still[use])
        shape = true_shape(poses.in_image, camera.matrix)
        per_px = metres_per_px(shape, stamps, _assumed_height(w.initial_joints))
        known = self._prior(stamps)
        before = self._continued(stamps)
        config = self._first if before is None else self._next
        _, refined, refusal = in_world(tracks, keypoints, poses, per_px, config, known, before)
        if refusal is not None:
            return self._refused(camera_result, refusal)
        if refined is None:
            return replace(camera_result, telemetry=TelemetryUse.LATE)
        self._known, self._before = known, (refined.before, refined.found)
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
            in_map=InMap(refined.rotation, refined.position, _correction(refined, tracks)),
        )

    def _refused(self, camera_result: AdjustedWindow, refusal: Refusal) -> AdjustedWindow:
        self._before = None
        return replace(camera_result, telemetry=TelemetryUse.REFUSED, reason=str(refusal))

    def _continued(self, stamps: np.ndarray) -> Before | None:
        """The window before, where the window of these stamps shares frames with it."""
        if self._before is None or stamps[0] > self._before[0].stamp_ns[-1]:
            return None
        return self._before[0]

    def _prior(self, stamps: np.ndarray) -> Findings:
        """Findings of earlier windows that the window of these stamps has not itself."""
        if self._before is None:
            return self._known
        (before, *_), found = self._before
        begin, end = int(before[0]), int(before[-1])
        share = float(np.clip((int(stamps[0]) - begin) / max(end - begin, 1), 0.0, 1.0))
        return self._known.later(found, share, max(int(stamps[-1]) - end, 0) * 1e-9)

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


def _tracks(stamp_ns: np.ndarray, keypoints: Keypoints2D, camera: WindowCamera) -> Tracks:
    return Tracks(
        keypoints=keypoints.xy,
        joints=BODY_17.joints,
        stamp_ns=stamp_ns,
        # The size of the images is unknown here, and not used.
        image_size=(math.ceil(camera.matrix[0, 0]), math.ceil(camera.matrix[1, 1])),
        camera_rotation=camera.rotation,
        camera_position=camera.position,
        camera_matrix=camera.matrix,
    )


def _correction(refined: RefinedWorld, tracks: Tracks) -> np.ndarray:
    assert tracks.camera_rotation is not None
    assert tracks.camera_position is not None
    turned = refined.rotation[-1:] @ np.swapaxes(tracks.camera_rotation[-1:], 1, 2)
    return np.concatenate([refined.position[-1] - tracks.camera_position[-1], log_so3(turned)[0]])


def _assumed_height(initial: np.ndarray) -> float:
    """Stature (m) that the initial poses (F, 17, 3) m assume."""
    known = np.isfinite(initial).all(axis=(1, 2))
    return float(np.median(limb_lengths(initial[known]).sum(axis=-1)) / LIMBS_PER_STATURE)
