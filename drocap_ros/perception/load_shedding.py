"""How much of a hurry the pose estimator is in."""

from __future__ import annotations

import math

#: Time without a picture that waited after which the hurry is one less: else the backlog that has just gone comes back.
_CALM_S = 1.0
#: A step up has to show what it does before the next one.
_STEP_S = 0.2


class Hurry:
    """A level from 0, there is time, to ``most``: one up when pictures wait, one down after a second without."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._level = 0
        self._waited_s = -math.inf
        self._raised_s = -math.inf

    def level(self, now_s: float, waited: bool, behind: int) -> int:
        """For the picture that has just been taken.

        Parameters
        ----------
        now_s : monotonic time
        waited : it lay there while the one before was worked on
        behind : how many lie there still
        """
        if waited:
            self._waited_s = now_s
            if now_s - self._raised_s >= _STEP_S and self._level < self._most:
                self._level, self._raised_s = self._level + 1, now_s
        elif self._level and now_s - self._waited_s >= _CALM_S:
            self._level, self._waited_s = self._level - 1, now_s
        return min(self._level + behind, self._most) if self._level else 0
