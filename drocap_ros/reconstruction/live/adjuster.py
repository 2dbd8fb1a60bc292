"""Adjustment of the live window, warm-started from the one before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.leg_sides import exchange, exchanged_legs
from drocap_ros.reconstruction.lifted.method import (
    Cancelled,
    DefaultResult,
    KnownBody,
    default_config,
    default_poses,
    prepare,
)
from drocap_ros.reconstruction.live.effort import Effort
from drocap_ros.reconstruction.live.frame_buffer import WindowArrays
from drocap_ros.reconstruction.live.initializer import MIN_WINDOW, AdjustedWindow, adjust_window
from drocap_ros.reconstruction.live.lifted_initializer import person_size
from drocap_ros.reconstruction.metrics import limb_lengths
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig
from drocap_ros.reconstruction.threads import blas_threads
from drocap_ros.skeleton import BODY_15

#: What an adjustment raises on arrays that it cannot solve.
SOLVER_ERRORS = (InputError, ValueError, ArithmeticError)

#: Sizes found in windows of fewer frames are no start for the next: too few views.
WARM_FRAMES = 72

#: Standard deviation of an adjusted pose over the lifter's expected errors, about the pelvis: across and along the
#: ray (measured on mocap/train's HDM05 sequences, from which the lifter has not learned).
ACROSS, ALONG = 1.2, 1.5


class WindowAdjuster:
    """Adjusts one window after the other by ``config.method``.

    "ba": the default method; bone lengths and size in the image of the last window start the next one, as long as
    the subject and the pass of time are the same.  "paper": equations (2) to (4) from the initial poses.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        if config.method == "ba":
            # A file that is no lifter is refused here, and the first window does not pay for loading.
            prepare(default_config(config))
        self._config = config
        self._known: tuple[int, np.ndarray, KnownBody] | None = None

    def adjust(
        self, window: WindowArrays, effort: Effort | None = None, cancelled: Cancelled | None = None
    ) -> AdjustedWindow:
        """Adjust a window.

        Parameters
        ----------
        effort : how coarsely; the result's ``stop_reason`` tells it where it is less than all
        cancelled : as of :func:`~drocap_ros.reconstruction.lifted.method.default_start_and_refine`; the steps that
            were taken are told, and given as ``effort`` they give the same result again

        Raises
        ------
        InputError
            When the window shows no person; what is known of the person stays.
        """
        effort = effort or Effort()
        part = _with_own_legs(window.every(effort.stride))
        with blas_threads(self._config.threads):
            if self._config.method == "paper":
                result, steps = self._by_paper(part, effort)
            else:
                result, steps = self._by_default(part, effort, cancelled)
        told = Effort(effort.stride, steps)
        return replace(result, stop_reason="; ".join(filter(None, (result.stop_reason, str(told)))))

    def _by_paper(self, w: WindowArrays, effort: Effort) -> tuple[AdjustedWindow, tuple[int, int] | None]:
        config = self._config
        if effort.steps is not None:
            config = replace(config, iterations=max(min(config.iterations, sum(effort.steps)), 1))
        return _by_equations(w, config), effort.steps

    def _by_default(
        self, w: WindowArrays, effort: Effort, cancelled: Cancelled | None
    ) -> tuple[AdjustedWindow, tuple[int, int] | None]:
        config = default_config(self._config)
        if effort.steps is not None:
            config = replace(config, first_iterations=effort.steps[0], iterations=effort.steps[1])
        if len(w.stamp_ns) < MIN_WINDOW:
            return _by_equations(w, self._config), effort.steps
        confidence = np.clip(np.nan_to_num(w.confidence), 0.0, 1.0)
        seen = np.isfinite(w.keypoints).all(axis=-1) & (confidence > 0.0)
        if seen.sum(axis=1).max(initial=0) < MIN_JOINTS:
            raise InputError(
                f"keypoints: expected an image with at least {MIN_JOINTS} seen joints; check the 2D joints"
            )
        points = np.where(seen[..., None], w.keypoints, np.nan)
        variance = 0.5 * (w.covariance[..., 0] + w.covariance[..., 2])
        variance = variance if np.isfinite(variance[seen]).any() else None
        found = default_poses(
            w.stamp_ns, points, confidence, variance, None, config, known=self._sizes(w), cancelled=cancelled
        )
        if not np.isfinite(found.joints).all():
            raise FloatingPointError("the solver found no finite poses")
        result = _to_window(w, seen, confidence, found)
        if len(w.stamp_ns) * effort.stride >= WARM_FRAMES:
            self._known = (w.subject, w.stamp_ns, found.body)
        stopped = found.stop_reason == "deadline" or effort.steps is not None
        return result, found.effort if stopped else None

    def _sizes(self, w: WindowArrays) -> KnownBody | None:
        if self._known is None or self._known[0] != w.subject:
            return None
        _, stamp_ns, body = self._known
        begin = stamp_ns[0]
        size = np.interp((w.stamp_ns - begin) * 1e-9, (stamp_ns - begin) * 1e-9, body.unit_per_mm)
        return KnownBody(body.lengths_mm, size)


def _with_own_legs(w: WindowArrays) -> WindowArrays:
    """The window with the legs exchanged back where the network most likely exchanged them."""
    seen = np.isfinite(w.keypoints).all(axis=-1)
    if not seen.any():
        return w
    confidence = np.where(seen, np.nan_to_num(w.confidence), 0.0)
    wrong = exchanged_legs(w.keypoints, confidence, w.stamp_ns, person_size(w.keypoints))
    if not wrong.any():
        return w
    keypoints, covariance, confidence = exchange(w.keypoints, w.covariance, w.confidence, wrong)
    return w._replace(keypoints=keypoints, covariance=covariance, confidence=confidence)


def _by_equations(w: WindowArrays, config: BundleAdjusterConfig) -> AdjustedWindow:
    covariance = None if np.isnan(w.covariance).all() else w.covariance
    return adjust_window(w.stamp_ns, w.keypoints, w.confidence, covariance, w.initial_joints, config)


def _to_window(w: WindowArrays, seen: np.ndarray, confidence: np.ndarray, found: DefaultResult) -> AdjustedWindow:
    gap = np.where(seen[..., None], found.joints[..., :2] - w.keypoints, 0.0)
    rms = np.sqrt(np.sum(gap**2, axis=(1, 2)) / np.maximum(seen.sum(axis=1), 1))
    pelvis = BODY_15.index("pelvis")
    # Each image in its own unit: bones of constant length, whatever the person's size in the image.
    joints = (found.joints - found.joints[:, pelvis, None]) / found.body.unit_per_mm[:, None, None]
    known = np.isfinite(w.initial_joints).all(axis=(1, 2))
    if not known.any():
        raise InputError("initial_joints: expected a pose in at least one frame, got NaN in all; check the start")
    # The scale of a monocular result is the start's: keep the mean limb length.
    metres = float(limb_lengths(w.initial_joints[known]).mean() / limb_lengths(joints).mean())
    std = found.sigma / found.body.unit_per_mm[:, None, None] * np.array([ACROSS, ALONG]) * metres
    covariance = np.zeros((*joints.shape[:2], 6))
    covariance[..., [0, 3, 5]] = std[..., [0, 0, 1]] ** 2
    return AdjustedWindow(
        stamp_ns=np.asarray(w.stamp_ns, dtype=np.int64),
        joints3d=joints * metres,
        covariance=covariance,
        confidence=np.where(seen, confidence, 0.0),
        reprojection_rms_px=np.where(seen.any(axis=1), rms, np.nan),
        iterations=sum(found.effort),
        cost=float(sum(found.cost_terms.values())),
        stop_reason=found.stop_reason,
        cost_terms=found.cost_terms,
    )
