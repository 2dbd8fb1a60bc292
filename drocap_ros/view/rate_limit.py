"""Rate limit of a stream by its stamps."""

from __future__ import annotations

#: Tolerance for jitter: images at 30 Hz limited to 10 Hz are every third.
_EARLY = 0.9


class RateLimit:
    """Thins a stream to a rate; a jump back in time restarts it.  Rate 0 keeps all messages."""

    def __init__(self, rate_hz: float) -> None:
        self._least_ns = round(_EARLY * 1e9 / rate_hz) if rate_hz > 0 else 0
        self._last_ns: int | None = None

    def due(self, stamp_ns: int) -> bool:
        """Whether the message of this stamp is kept."""
        if self._last_ns is not None and 0 <= stamp_ns - self._last_ns < self._least_ns:
            return False
        self._last_ns = stamp_ns
        return True
