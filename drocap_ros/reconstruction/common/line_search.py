"""Search for a lower cost on the line of a Gauss-Newton step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol, TypeVar

#: Most points that are tried on the line.
_TRIALS = 10


class _Costed(Protocol):
    @property
    def cost(self) -> float: ...


_Point = TypeVar("_Point", bound=_Costed)


def search_line(cost: float, slope: float, point_at: Callable[[float], _Point | None]) -> _Point | None:
    """A point whose cost is at most ``cost``: the step's end, or where parabolas through the points put the minimum.

    Parameters
    ----------
    slope : derivative of the cost along the step at its beginning
    point_at : point at a share of the step; None = not allowed

    Returns
    -------
    None where ten points have a higher cost, one that is not finite, or are not allowed.
    """
    share = 1.0
    for _ in range(_TRIALS):
        there = point_at(share)
        if there is not None and there.cost <= cost:
            return there
        high = there.cost if there is not None and math.isfinite(there.cost) else math.inf
        bend = (high - cost) / share - slope
        share *= min(max(-0.5 * slope / max(bend, 1e-300), 0.1), 0.5)
    return None
