"""Level of load shedding: how much less work per image, while images queue."""

from __future__ import annotations

import math

_CALM_S = 1.0  # time without a queued image before the level falls; a shorter one lets the backlog return at once
_RISE_S = 0.2  # shortest time between two rises: each level needs time to take effect


class LoadShedding:
    """Level from 0 (full work) to ``max_level``: rises while images queue, falls by one per second without."""

    def __init__(self, max_level: int) -> None:
        self._max_level = max_level
        self._level = 0
        self._queued_s = -math.inf
        self._raised_s = -math.inf

    def level(self, now_s: float, queued: bool, backlog: int) -> int:
        """Level for the current image.

        Parameters
        ----------
        now_s : monotonic time
        queued : whether the image arrived while the previous one was processed
        backlog : number of images still queued
        """
        if queued:
            self._queued_s = now_s
            if now_s - self._raised_s >= _RISE_S and self._level < self._max_level:
                self._level, self._raised_s = self._level + 1, now_s
        elif self._level and now_s - self._queued_s >= _CALM_S:
            self._level, self._queued_s = self._level - 1, now_s
        return min(self._level + backlog, self._max_level) if self._level else 0
