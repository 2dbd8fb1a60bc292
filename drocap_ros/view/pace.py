"""Fewer of a stream's messages, for who cannot use them all."""

from __future__ import annotations

#: A tenth of tolerance: pictures at 30 Hz thinned to 10 Hz are every third, whatever the jitter.
_EARLY = 0.9


class Pace:
    """Thins a stream to a rate by its stamps; after a jump back it begins anew.  A rate of 0 lets all through."""

    def __init__(self, rate_hz: float) -> None:
        self._least_ns = round(_EARLY * 1e9 / rate_hz) if rate_hz > 0 else 0
        self._last_ns: int | None = None

    def due(self, stamp_ns: int) -> bool:
        """Whether the message of this stamp is one of those that stay."""
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._least_ns:
            return False
        self._last_ns = stamp_ns
        return True
