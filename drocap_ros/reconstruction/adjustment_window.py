"""The sliding window that the bundle adjuster works on."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from drocap_ros.perception.observation import PoseObservation
from drocap_ros.reconstruction.config import BundleAdjusterConfig


class WindowArrays(NamedTuple):
    """Arguments of :func:`~drocap_ros.reconstruction.window.adjust_window`, F frames."""

    stamp_ns: np.ndarray
    keypoints: np.ndarray
    confidence: np.ndarray
    covariance: np.ndarray
    initial_joints: np.ndarray


class AdjustmentWindow:
    """The last ``window_s`` of keypoints and initial poses of one subject; says when an adjustment is due.

    Time is that of the stamps.  A stamp that does not come after the last one, or another subject, starts the
    window anew.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = config
        self._frames: deque[tuple[PoseObservation, np.ndarray]] = deque(maxlen=config.window_frames)
        self._last_due_ns: int | None = None

    def push(self, observation: PoseObservation, initial_joints: np.ndarray) -> bool:
        """Add a frame; True when ``period_s`` has passed since the last time this was True.

        initial_joints : (15, 3) m, camera axes
        """
        if self._frames:
            last = self._frames[-1][0]
            if observation.stamp_ns <= last.stamp_ns or observation.track_id != last.track_id:
                self._frames.clear()
                self._last_due_ns = None
        self._frames.append((observation, initial_joints))
        oldest = observation.stamp_ns - round(self._config.window_s * 1e9)
        while self._frames[0][0].stamp_ns < oldest:
            self._frames.popleft()
        if self._last_due_ns is None:
            self._last_due_ns = observation.stamp_ns
        due = observation.stamp_ns - self._last_due_ns >= round(self._config.period_s * 1e9)
        if due:
            self._last_due_ns = observation.stamp_ns
        return due

    def snapshot(self) -> WindowArrays:
        """The window's arrays, float64."""
        observations = [observation for observation, _ in self._frames]
        return WindowArrays(
            np.array([o.stamp_ns for o in observations], np.int64),
            np.array([o.keypoints for o in observations], np.float64),
            np.array([o.confidence for o in observations], np.float64),
            np.array([o.covariance for o in observations], np.float64),
            np.array([joints for _, joints in self._frames], np.float64),
        )
