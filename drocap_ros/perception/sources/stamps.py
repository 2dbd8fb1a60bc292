"""From a driver's or stream's own time to the clock's."""

from __future__ import annotations

#: A stream's clock may run slower than ours by so much (crystals are good to 50 ppm).
_DRIFT = 2e-4


class StreamClock:
    """Maps presentation times to the time of ``now``.

    The offset between the two is the smallest difference between arrival and presentation time seen so far:
    the network and the decoder only ever add delay.  It may creep up by 0.2 per mille, so that a slower
    foreign clock is followed.
    """

    def __init__(self) -> None:
        self._offset: float | None = None
        self._position = 0
        self._last = 0

    def stamp(self, position_ns: int, now_ns: int) -> int:
        """Stamp of an image with presentation time ``position_ns`` that arrived at ``now_ns``; strictly increasing."""
        difference = now_ns - position_ns
        if self._offset is None or position_ns < self._position:  # the first, or the stream's time began anew
            self._offset = difference
        else:
            self._offset = min(self._offset + _DRIFT * (position_ns - self._position), difference)
        self._position = position_ns
        self._last = max(position_ns + round(self._offset), self._last + 1)
        return self._last
