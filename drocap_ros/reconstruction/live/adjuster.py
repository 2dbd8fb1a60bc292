"""Adjusts live windows, each warm-started from the one before."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.rotations import unpack_covariance
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.leg_sides import with_own_legs
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.engine import blas_threads
from drocap_ros.reconstruction.common.poses import DEADLINE, ImagePoses, packed
from drocap_ros.reconstruction.lifted.body_size import BodySize, magnification
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig, lifted_config
from drocap_ros.reconstruction.lifted.method import WindowSolution, prepare, solve_window
from drocap_ros.reconstruction.lifted.window_solver import Cancelled
from drocap_ros.reconstruction.live.initializer import person_size
from drocap_ros.reconstruction.live.picture_windows import PictureWindows
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, TelemetryUse, Window
from drocap_ros.reconstruction.live.world_windows import WorldWindows
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS
from drocap_ros.reconstruction.person_view import person_view
from drocap_ros.skeleton import BODY_15

#: Errors that an adjustment raises on arrays that it cannot solve.
SOLVER_ERRORS = (InputError, ValueError, ArithmeticError)

#: Sizes from windows of fewer frames do not start the next window: too few views.
WARM_FRAMES = 72


class LiveAdjuster:
    """Adjusts one window after the other by the default method.

    Bone lengths and size in the image of the last window start the next one, while the subject and the pass of time
    are the same.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        # An invalid lifter file is refused here, and the first window does not pay for loading.
        prepare(lifted_config(config, drawn_toes=True))
        self._config = config
        self._known: tuple[int, np.ndarray, BodySize] | None = None
        self._world, self._picture = WorldWindows(config), PictureWindows(config)

    def adjust(
        self, window: Window, effort: Effort | None = None, cancelled: Cancelled | None = None
    ) -> AdjustedWindow:
        """Adjust a window.

        effort : limits of the work; None = no limit beyond the configuration
        cancelled : as of :func:`~drocap_ros.reconstruction.lifted.method.solve_even_window`; the result's
            ``effort`` holds the steps taken and repeats the result
        """
        effort = effort or Effort()
        part = window.every(effort.stride)
        keypoints = with_own_legs(part.keypoints, part.stamp_ns, person_size(part.keypoints.xy))
        part = part._replace(keypoints=keypoints)
        with blas_threads(self._config.threads):
            return self._by_default(part, effort, cancelled)

    def adjust_within(self, window: Window, effort: Effort, limit_s: float | None) -> AdjustedWindow:
        """Adjust a window; end after the step in which a time (s) is over, None = none is."""
        end_s = time.perf_counter() + (math.inf if limit_s is None else limit_s)
        return self.adjust(window, effort, None if limit_s is None else lambda: time.perf_counter() > end_s)

    def _by_default(self, w: Window, effort: Effort, cancelled: Cancelled | None) -> AdjustedWindow:
        config = lifted_config(self._config, drawn_toes=True)
        if effort.steps is not None:
            config = replace(config, first_iterations=effort.steps[0], iterations=effort.steps[1])
        confidence = np.clip(w.keypoints.weights, 0.0, 1.0)
        seen = confidence > 0.0
        if seen.sum(axis=1).max(initial=0) < MIN_JOINTS:
            raise InputError(
                f"keypoints: expected an image with at least {MIN_JOINTS} seen joints; check the 2D joints"
            )
        variance = w.keypoints.variance
        covariance = w.keypoints.covariance if variance is not None and np.isfinite(variance[seen]).any() else None
        keypoints = Keypoints2D(np.where(seen[..., None], w.keypoints.xy, np.nan), confidence, covariance)
        w = w._replace(keypoints=keypoints)
        rotation = w.camera.rotation if w.camera is not None and self._world.trusted else None
        result, found = self._solve(w, rotation, config, effort, cancelled)
        final = self._world.adjust(w, found, result)
        if rotation is not None and not self._world.trusted:
            # The lifter saw the camera's rotation: without it the poses differ too.  The same steps repeat this.
            if (steps := result.effort.steps) is not None:
                config = replace(config, first_iterations=steps[0], iterations=steps[1])
            again, found = self._solve(w, None, config, effort, None)
            final = replace(again, effort=result.effort, telemetry=final.telemetry, reason=final.reason)
        if final.telemetry is TelemetryUse.NONE:
            final = self._picture.adjust(w, found, final)
        if len(w.stamp_ns) * effort.stride >= WARM_FRAMES:
            self._known = (w.subject, w.stamp_ns, found.body)
        return final

    def _solve(
        self,
        w: Window,
        rotation: np.ndarray | None,
        config: LiftedConfig,
        effort: Effort,
        cancelled: Cancelled | None,
    ) -> tuple[AdjustedWindow, WindowSolution]:
        """Poses in camera axes and in px of the image, with what is known of the camera."""
        focal, view = w.assumed_focal_px, None
        if w.camera is not None:
            focal = w.camera.focal_px
            turned = None if rotation is None else _without_gaps(rotation)
            view = person_view(w.keypoints, w.camera.matrix, turned, (0, 0))
        seen = w if view is None else w._replace(keypoints=view.keypoints(w.keypoints))
        turned = rotation if view is None else view.rotation(rotation)
        found = solve_window(w.stamp_ns, seen.keypoints, focal, config, self._sizes(w), cancelled, turned)
        if not np.isfinite(found.joints).all():
            raise FloatingPointError("the solver found no finite poses")
        steps = found.steps if found.stop_reason == DEADLINE or effort.steps is not None else None
        result = _adjusted(seen, found, focal, Effort(effort.stride, steps))
        if view is None:
            return result, found
        poses = view.in_image(ImagePoses.centred(found.joints, found.sigma))
        assert poses.sigma_px is not None
        return _turned_back(result, view.turn), replace(found, joints=poses.in_image, sigma=poses.sigma_px)

    def _sizes(self, w: Window) -> BodySize | None:
        if self._known is None or self._known[0] != w.subject:
            return None
        _, stamp_ns, body = self._known
        begin = stamp_ns[0]
        size = np.interp((w.stamp_ns - begin) * 1e-9, (stamp_ns - begin) * 1e-9, body.unit_per_mm)
        return BodySize(body.lengths_mm, size)


def _without_gaps(rotation: np.ndarray) -> np.ndarray | None:
    """Rotations (F, 3, 3) with those of the nearest known frame where they are NaN; None = all are."""
    known = np.flatnonzero(np.isfinite(rotation).all(axis=(1, 2)))
    if not len(known):
        return None
    nearest = np.abs(np.arange(len(rotation))[:, None] - known).argmin(axis=1)
    return np.asarray(rotation[known[nearest]])


def _turned_back(result: AdjustedWindow, turn: np.ndarray) -> AdjustedWindow:
    """Poses in the axes of a view, ``turn`` (F, 3, 3) camera -> view, in those of the camera."""
    back = turn[:, None]
    full = np.swapaxes(back, -1, -2) @ unpack_covariance(result.covariance) @ back
    return replace(result, joints3d=result.joints3d @ turn, covariance=packed(full))


def _adjusted(w: Window, found: WindowSolution, focal: float | None, effort: Effort) -> AdjustedWindow:
    confidence = w.keypoints.weights
    seen = confidence > 0.0
    gap = np.where(seen[..., None], found.joints[..., :2] - w.keypoints.xy, 0.0)
    rms = np.sqrt(np.sum(gap**2, axis=(1, 2)) / np.maximum(seen.sum(axis=1), 1))
    pelvis = BODY_15.index("pelvis")
    # Each image in its own unit: bones keep their length although the person's size in the image changes.
    joints = (found.joints - found.joints[:, pelvis, None]) / found.body.unit_per_mm[:, None, None]
    if focal is not None:
        # The image is a perspective one: joints behind the pelvis lie towards the axis.
        joints[..., :2] *= magnification(joints[..., 2], focal / found.body.unit_per_mm)
    known = np.isfinite(w.initial_joints).all(axis=(1, 2))
    if not known.any():
        raise InputError("initial_joints: expected a pose in at least one frame, got NaN in all; check the 2D joints")
    # The scale of a monocular result is that of the initial poses: keep the mean limb length.
    metres = float(limb_lengths(w.initial_joints[known]).mean() / limb_lengths(joints).mean())
    sigma = found.sigma / found.body.unit_per_mm[:, None, None] * metres
    return AdjustedWindow(
        stamp_ns=np.asarray(w.stamp_ns, dtype=np.int64),
        joints3d=joints * metres,
        covariance=packed(found.spread.covariance(joints * metres, sigma)),
        confidence=np.where(seen, confidence, 0.0),
        reprojection_rms_px=np.where(seen.any(axis=1), rms, np.nan),
        iterations=sum(found.steps),
        cost=float(sum(found.cost_terms.values())),
        stop_reason=found.stop_reason,
        cost_terms=found.cost_terms,
        effort=effort,
    )
