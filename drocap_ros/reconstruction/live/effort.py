"""Work that a live adjustment may do: a late node adjusts fewer images."""

from __future__ import annotations

from dataclasses import dataclass

#: Share of the allowed time above which the next window gets coarser, and below which it gets finer.
_TOO_LONG, _SHORT = 0.9, 0.45


@dataclass(frozen=True)
class Effort:
    """Every ``stride``-th image, counted from the newest.

    steps : limits of the first and of the final adjustment of the default method; None = the configured ones
    """

    stride: int = 1
    steps: tuple[int, int] | None = None


class EffortControl:
    """Chooses the stride of the next window from the duration of the last adjustment.

    Parameters
    ----------
    allowed_s : for one adjustment
    max_stride : the coarsest
    """

    def __init__(self, allowed_s: float, max_stride: int) -> None:
        self._allowed_s, self._max_stride = allowed_s, max_stride
        self.stride = 1

    def record(self, seconds: float) -> None:
        """Record the duration of an adjustment with the present stride."""
        if seconds > _TOO_LONG * self._allowed_s:
            self.stride = min(self.stride + 1, self._max_stride)
        elif self.stride > 1 and seconds * self.stride / (self.stride - 1) < _SHORT * self._allowed_s:
            self.stride -= 1
