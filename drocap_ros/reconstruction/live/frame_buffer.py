"""The sliding window that the bundle adjuster works on."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.live.stream_order import Arrival, StreamOrder
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig

#: The first adjustment of a window is due after this fraction of a period.
_FIRST = 3


class WindowArrays(NamedTuple):
    """A window of F frames for :class:`~drocap_ros.reconstruction.live.adjuster.WindowAdjuster`.

    stamp_ns : (F,) increasing; keypoints : (F, 15, 2) px; confidence : (F, 15); covariance : (F, 15, 3) px^2
    initial_joints : (F, 15, 3) m, camera axes
    subject : changes with the subject and with every new pass of time
    """

    stamp_ns: np.ndarray
    keypoints: np.ndarray
    confidence: np.ndarray
    covariance: np.ndarray
    initial_joints: np.ndarray
    subject: int = 0

    def every(self, stride: int) -> WindowArrays:
        """Every ``stride``-th frame, counted back from the newest."""
        chosen = slice((len(self.stamp_ns) - 1) % stride, None, stride)
        return WindowArrays(
            self.stamp_ns[chosen],
            self.keypoints[chosen],
            self.confidence[chosen],
            self.covariance[chosen],
            self.initial_joints[chosen],
            self.subject,
        )


class AdjustmentWindow:
    """The last ``window_s`` of keypoints and initial poses of one subject; says when an adjustment is due.

    That is every ``period_s``, and the first time after a third of it: somebody who has just been found, or a node that
    was started again, has no solution yet that could serve meanwhile, and so few frames are soon adjusted.

    Time is that of the stamps.  ``arrival`` says what the last frame was to the stream: a duplicate or late one is
    dropped; another subject, a jump of time or a gap longer than ``gap_s`` starts the window anew.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = config
        self._frames: deque[tuple[PoseObservation, np.ndarray]] = deque(maxlen=config.window_frames)
        self._due_ns: int | None = None
        # The initializer has asked each jump for confirmation before it gave the pose that comes here.
        self._order = StreamOrder(config.late_s, config.gap_s, confirm=False)
        self.arrival = Arrival.STARTED
        self.subject = 0

    def push(self, observation: PoseObservation, initial_joints: np.ndarray) -> bool:
        """Add a frame; True when an adjustment is due.

        initial_joints : (15, 3) m, camera axes
        """
        self.arrival = self._order.accept(observation.stamp_ns, observation.track_id)
        if self.arrival.dropped:
            return False
        if self.arrival.anew:
            self.subject += 1
        if self.arrival is not Arrival.CONTINUED:
            self._frames.clear()
            self._due_ns = None
        self._frames.append((observation, initial_joints))
        oldest = observation.stamp_ns - round(self._config.window_s * 1e9)
        while self._frames[0][0].stamp_ns < oldest:
            self._frames.popleft()
        period_ns = round(self._config.period_s * 1e9)
        if self._due_ns is None:
            self._due_ns = observation.stamp_ns + period_ns // _FIRST
        due = observation.stamp_ns >= self._due_ns
        if due:
            self._due_ns = observation.stamp_ns + period_ns
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
            self.subject,
        )
