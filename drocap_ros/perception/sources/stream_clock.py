"""Conversion of a driver's or stream's time to the system clock."""

from __future__ import annotations

#: Largest relative drift of a slower stream clock; crystals are accurate to 50 ppm.
_DRIFT = 2e-4
#: Beyond this the system clock was set; less is a pause between two readings of the clocks.
_SET_NS = 100_000_000


class StreamClock:
    """Maps presentation times to the system clock.

    The offset is the smallest difference between arrival and presentation time so far, because network and decoder
    only add delay.  It grows by 0.2 per mille of the elapsed time, to follow a slower stream clock.  A system clock
    that is set (NTP, after a start without a battery clock) is no delay: stamps follow it at once, also back.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._position = 0
        self._last = 0
        self._system_ns: int | None = None  # system clock minus steady clock

    def stamp(self, position_ns: int, now_ns: int, steady_ns: int | None = None) -> int:
        """Stamp of an image with presentation time ``position_ns`` that arrived at ``now_ns``; strictly increasing
        while nobody sets the clock.

        steady_ns : arrival by a clock that nobody sets; None = nobody sets the system clock
        """
        system_ns = now_ns - (now_ns if steady_ns is None else steady_ns)
        set_ns = 0 if self._system_ns is None else system_ns - self._system_ns
        self._system_ns = system_ns
        if abs(set_ns) > _SET_NS and self._offset is not None:
            self._offset += set_ns
            self._last += min(set_ns, 0)
        difference = now_ns - position_ns
        if self._offset is None or position_ns < self._position:  # first image, or the stream restarted
            self._offset = difference
        else:
            self._offset = min(self._offset + _DRIFT * (position_ns - self._position), difference)
        self._position = position_ns
        self._last = max(position_ns + round(self._offset), self._last + 1)
        return self._last
