"""Order of the images of a live stream: which continue it, which begin anew, which are dropped."""

from __future__ import annotations

from enum import Enum

#: A stamp that leaps further ahead than this is believed only when the next one follows it.
LEAP_S = 60.0

#: So many late images in a row mean that the clock was set back by less than ``late_s``.
LATE_RUN = 10


class Arrival(Enum):
    """What an image is to the images before it; the value says it in words."""

    STARTED = "first image"
    CONTINUED = "continued"
    GAP = "continued after a gap"
    NEW_SUBJECT = "another subject"
    RESTARTED = "time jumped: started anew"
    DUPLICATE = "duplicate stamp"
    LATE = "late: its stamp lies before the last one"
    STRAY = "stamp far from the stream's"

    @property
    def dropped(self) -> bool:
        """The image takes no part."""
        return self in (Arrival.DUPLICATE, Arrival.LATE, Arrival.STRAY)

    @property
    def anew(self) -> bool:
        """Nothing of what was known holds: another person, or another pass of time."""
        return self in (Arrival.STARTED, Arrival.NEW_SUBJECT, Arrival.RESTARTED)


class StreamOrder:
    """Judges each image by its stamp and its subject.

    - The same stamp again: a duplicate, dropped.
    - Up to ``late_s`` before the last stamp: late, dropped; after :data:`LATE_RUN` in a row the clock was set back.
    - Further back, or more than :data:`LEAP_S` ahead: dropped as a stray, unless it follows a stray, for then time
      has jumped (a looped bag, a clock that was set) and the stream starts anew.  So one stamp of 1970 or 2100 does no
      harm, and a stream that lives in 1970 or 2100 is as good as any.
    - Another ``track_id``: starts anew.  More than ``gap_s`` later: a gap.

    Parameters
    ----------
    confirm : False believes every jump at once, for images that another order has let through
    """

    def __init__(self, late_s: float, gap_s: float, *, confirm: bool = True) -> None:
        self._late_ns, self._gap_ns, self._leap_ns = (round(s * 1e9) for s in (late_s, gap_s, LEAP_S))
        self._confirm = confirm
        self.reset()

    def reset(self) -> None:
        """Forget the stream."""
        self._last: tuple[int, int] | None = None
        self._stray_ns: int | None = None
        self._late = 0

    def accept(self, stamp_ns: int, track_id: int) -> Arrival:
        """Judge the next image; what is dropped leaves no trace in the order of the others."""
        arrival = self._judge(stamp_ns, track_id)
        if arrival.dropped:
            self._late += arrival is Arrival.LATE
            if arrival is Arrival.STRAY:
                self._stray_ns = stamp_ns
        else:
            self._last, self._stray_ns, self._late = (stamp_ns, track_id), None, 0
        return arrival

    def _judge(self, stamp_ns: int, track_id: int) -> Arrival:
        if self._last is None:
            return Arrival.STARTED
        step = stamp_ns - self._last[0]
        if step == 0:
            return Arrival.DUPLICATE
        if -self._late_ns <= step < 0:
            return Arrival.LATE if self._late < LATE_RUN else Arrival.RESTARTED
        if step < 0 or step > self._leap_ns:
            follows = self._stray_ns is not None and 0 < stamp_ns - self._stray_ns <= self._leap_ns
            return Arrival.RESTARTED if follows or not self._confirm else Arrival.STRAY
        if track_id != self._last[1]:
            return Arrival.NEW_SUBJECT
        return Arrival.GAP if step > self._gap_ns else Arrival.CONTINUED
