"""The frames of the live window, joined from two topics, and the time of the next adjustment."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Generic, TypeVar

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.stream_order import StreamEvent, StreamOrder
from drocap_ros.reconstruction.live.window import Window
from drocap_ros.reconstruction.person_view import assumed_focal_px

#: The first adjustment is due after this fraction of a period: no earlier solution can serve meanwhile.
_FIRST = 3


First = TypeVar("First")
Second = TypeVar("Second")
Part = TypeVar("Part")


class FrameBuffer:
    """The last ``window_s`` of keypoints and initial poses of one subject; an adjustment is due every ``period_s``.

    Time is that of the stamps.  ``event`` is the last frame's: duplicate and late frames are dropped; another
    subject or image size, a jump of time and a gap longer than ``gap_s`` empty the buffer.
    """

    def __init__(self, config: BundleAdjusterConfig) -> None:
        self._config = config
        self._frames: deque[tuple[PoseObservation, np.ndarray]] = deque(maxlen=config.window_frames)
        self._due_ns: int | None = None
        # The initializer has confirmed each jump before it published the pose.
        self._order = StreamOrder(config.late_s, config.gap_s, confirm=False)
        self.event = StreamEvent.FIRST
        self.subject = 0

    def push(self, observation: PoseObservation, initial_joints: np.ndarray) -> bool:
        """Add a frame; True when an adjustment is due.

        initial_joints : (17, 3) m, camera axes; (15, 3) from older recordings
        """
        self.event = self._order.classify(observation.stamp_ns, observation.track_id, observation.image_size)
        if self.event.dropped:
            return False
        if self.event.restarted:
            self.subject += 1
        if self.event is not StreamEvent.CONTINUED:
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

    def window(self) -> Window:
        """Copy of the frames, float64."""
        observations = [observation for observation, _ in self._frames]
        count = min(len(joints) for _, joints in self._frames)
        keypoints = [observation.body_keypoints() for observation in observations]
        return Window(
            np.array([o.stamp_ns for o in observations], np.int64),
            Keypoints2D(
                np.array([k.xy for k in keypoints]),
                np.array([k.confidence for k in keypoints]),
                np.array([k.covariance for k in keypoints]),
            ),
            np.array([joints[:count] for _, joints in self._frames], np.float64),
            self.subject,
            image_size=observations[-1].image_size,
            assumed_focal_px=assumed_focal_px(observations[-1].image_size, self._config.assumed_focal),
        )


class StampJoin(Generic[First, Second]):
    """Pairs of the same stamp; topics keep no order between them, so either part may come first.

    At most ``max_pending`` of each part wait; the oldest are dropped.
    """

    def __init__(self, max_pending: int) -> None:
        self._max_pending = max_pending
        self._first: OrderedDict[int, First] = OrderedDict()
        self._second: OrderedDict[int, Second] = OrderedDict()
        #: Parts dropped without their counterpart.
        self.dropped_first = self.dropped_second = 0

    def add_first(self, stamp_ns: int, item: First) -> tuple[First, Second] | None:
        """The pair that the item completes, or None."""
        if stamp_ns in self._second:
            return item, self._second.pop(stamp_ns)
        self.dropped_first += self._wait(self._first, stamp_ns, item)
        return None

    def add_second(self, stamp_ns: int, item: Second) -> tuple[First, Second] | None:
        """The pair that the item completes, or None."""
        if stamp_ns in self._first:
            return self._first.pop(stamp_ns), item
        self.dropped_second += self._wait(self._second, stamp_ns, item)
        return None

    def _wait(self, pending: OrderedDict[int, Part], stamp_ns: int, item: Part) -> int:
        """Number of parts dropped for the new one."""
        pending[stamp_ns] = item
        dropped = max(len(pending) - self._max_pending, 0)
        for _ in range(dropped):
            pending.popitem(last=False)
        return dropped
