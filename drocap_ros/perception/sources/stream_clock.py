"""Conversion of a driver's or stream's time to the system clock."""

from __future__ import annotations

#: Largest relative drift of a slower stream clock; crystals are accurate to 50 ppm.
_DRIFT = 2e-4


class StreamClock:
    """Maps presentation times to the system clock.

    The offset is the smallest difference between arrival and presentation time so far, because network and decoder
    only add delay.  It grows by 0.2 per mille of the elapsed time, to follow a slower stream clock.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._position = 0
        self._last = 0

    def stamp(self, position_ns: int, now_ns: int) -> int:
        """Stamp of an image with presentation time ``position_ns`` that arrived at ``now_ns``; strictly increasing."""
        difference = now_ns - position_ns
        if self._offset is None or position_ns < self._position:  # first image, or the stream restarted
            self._offset = difference
        else:
            self._offset = min(self._offset + _DRIFT * (position_ns - self._position), difference)
        self._position = position_ns
        self._last = max(position_ns + round(self._offset), self._last + 1)
        return self._last
