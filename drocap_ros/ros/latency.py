"""How late a node's results are."""

from __future__ import annotations

from collections import deque

import numpy as np

#: Keys of these figures on ``/diagnostics``.
RATE, LATENCY = "rate Hz", "latency p50 / p95 / p99 ms"
#: Key of who is followed, and of why the last refused message was refused.
SUBJECT, LAST_REFUSED = "subject", "last refused"
#: One number alone, for viewers that plot it.
LATENCY_P95 = "latency p95 ms"


class Latency:
    """Percentiles of the last measurements, and their rate; bounded memory."""

    def __init__(self, size: int = 512) -> None:
        self._seconds: deque[float] = deque(maxlen=size)
        self._at_s: deque[float] = deque(maxlen=size)

    def add(self, seconds: float, now_s: float) -> None:
        """Take one measurement, made at ``now_s`` of a monotonic clock."""
        self._seconds.append(seconds)
        self._at_s.append(now_s)

    def rate_hz(self, now_s: float, window_s: float = 5.0) -> float:
        """Measurements per second over the last seconds."""
        recent = sum(now_s - at <= window_s for at in tuple(self._at_s))  # another thread may add meanwhile
        return recent / window_s

    def text_ms(self) -> str:
        """``p50 / p95 / p99 ms``, empty without measurements."""
        if not self._seconds:
            return ""
        return " / ".join(f"{1000 * value:.0f}" for value in np.percentile(np.array(self._seconds), [50, 95, 99]))

    def p95_ms(self) -> float:
        """95th percentile, NaN without measurements."""
        return 1000.0 * float(np.percentile(np.array(self._seconds), 95)) if self._seconds else float("nan")
