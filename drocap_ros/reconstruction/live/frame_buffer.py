"""The order of a stream's images, the frames of the live window, and the time of the next adjustment."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto

import numpy as np

from drocap_ros.keypoints import Keypoints2D, PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.live.window import Window
from drocap_ros.reconstruction.person_view import assumed_focal_px

#: A stamp further ahead than this counts only when the next one follows it.
LEAP_S = 60.0

#: Late images in a row that prove a clock set back by less than ``late_s``.
LATE_RUN = 10


class StreamEvent(Enum):
    """Relation of an image to the images before it."""

    FIRST = auto()
    CONTINUED = auto()
    GAP = auto()
    NEW_SUBJECT = auto()
    RESIZED = auto()
    TIME_JUMP = auto()
    DUPLICATE = auto()
    LATE = auto()
    STRAY = auto()

    def __str__(self) -> str:
        return _WORDS[self]

    @property
    def dropped(self) -> bool:
        """The image takes no part."""
        return self in (StreamEvent.DUPLICATE, StreamEvent.LATE, StreamEvent.STRAY)

    @property
    def restarted(self) -> bool:
        """Earlier state is void: another person, other pixels, or another pass of time."""
        return self in (StreamEvent.FIRST, StreamEvent.NEW_SUBJECT, StreamEvent.RESIZED, StreamEvent.TIME_JUMP)


_WORDS = {
    StreamEvent.FIRST: "first image",
    StreamEvent.CONTINUED: "continued",
    StreamEvent.GAP: "continued after a gap",
    StreamEvent.NEW_SUBJECT: "restarted: another subject",
    StreamEvent.RESIZED: "restarted: images of another size",
    StreamEvent.TIME_JUMP: "restarted: time jumped",
    StreamEvent.DUPLICATE: "dropped: duplicate stamp",
    StreamEvent.LATE: "dropped: late stamp",
    StreamEvent.STRAY: "dropped: stray stamp",
}


class StreamOrder:
    """Classifies each image by its stamp, its subject and its size.

    - The same stamp again: a duplicate, dropped.
    - Up to ``late_s`` before the last stamp: late, dropped; after :data:`LATE_RUN` in a row the clock was set back.
    - Further back, or more than :data:`LEAP_S` ahead: a stray, dropped, unless it follows a stray; then time has
      jumped (a looped bag, a clock that was set) and the stream restarts.  A single stamp of 1970 or 2100 does no
      harm, and a whole stream in 1970 or 2100 works.
    - Another ``track_id`` or image size: the stream restarts.  More than ``gap_s`` later: a gap.

    confirm : False accepts every jump at once, for images that another order has accepted
    """

    def __init__(self, late_s: float, gap_s: float, *, confirm: bool = True) -> None:
        self._late_ns, self._gap_ns, self._leap_ns = (round(s * 1e9) for s in (late_s, gap_s, LEAP_S))
        self._confirm = confirm
        self._last: tuple[int, int, tuple[int, int]] | None = None
        self._stray_ns: int | None = None
        self._late = 0

    def classify(self, stamp_ns: int, track_id: int, size: tuple[int, int] = (0, 0)) -> StreamEvent:
        """Event of the next image, ``size`` px; a dropped image does not change the order of the others."""
        event = self._event(stamp_ns, track_id, size)
        if event.dropped:
            self._late += event is StreamEvent.LATE
            if event is StreamEvent.STRAY:
                self._stray_ns = stamp_ns
        else:
            self._last, self._stray_ns, self._late = (stamp_ns, track_id, size), None, 0
        return event

    def _event(self, stamp_ns: int, track_id: int, size: tuple[int, int]) -> StreamEvent:
        if self._last is None:
            return StreamEvent.FIRST
        step = stamp_ns - self._last[0]
        if step == 0:
            return StreamEvent.DUPLICATE
        if -self._late_ns <= step < 0:
            return StreamEvent.LATE if self._late < LATE_RUN else StreamEvent.TIME_JUMP
        if not 0 < step <= self._leap_ns:
            return StreamEvent.STRAY if self._confirm and not self._follows_stray(stamp_ns) else StreamEvent.TIME_JUMP
        if (track_id, size) != self._last[1:]:
            return StreamEvent.RESIZED if track_id == self._last[1] else StreamEvent.NEW_SUBJECT
        return StreamEvent.GAP if step > self._gap_ns else StreamEvent.CONTINUED

    def _follows_stray(self, stamp_ns: int) -> bool:
        return self._stray_ns is not None and 0 < stamp_ns - self._stray_ns <= self._leap_ns


#: The first adjustment is due after this fraction of a period: no earlier solution can serve meanwhile.
_FIRST = 3


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
            track_id=observations[-1].track_id,
            image_size=observations[-1].image_size,
            assumed_focal_px=assumed_focal_px(observations[-1].image_size, self._config.assumed_focal),
        )
