"""Latency and rate of a node's results."""

from __future__ import annotations

from collections import deque

import numpy as np


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

    def percentiles_ms(self) -> tuple[float, ...]:
        """50th, 95th and 99th percentile, ms; empty without measurements."""
        if not self._seconds:
            return ()
        return tuple(1000.0 * float(value) for value in np.percentile(np.array(self._seconds), [50, 95, 99]))
