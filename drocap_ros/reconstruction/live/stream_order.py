"""Order of the images of a live stream: each image continues it, restarts it or is dropped."""

from __future__ import annotations

from enum import Enum, auto

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

    Parameters
    ----------
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
