"""How much work a live adjustment may do: coarser when it is late, and told in its result, so that it can be redone."""

from __future__ import annotations

import re
from dataclasses import dataclass

_STRIDE = re.compile(r"every (\d+)\. image")
_STEPS = re.compile(r"(\d+) \+ (\d+) steps")

#: Share of the time allowed above which the next window is taken more coarsely, and below which more finely.
_TOO_LONG, _SHORT = 0.9, 0.45


@dataclass(frozen=True)
class Effort:
    """Every ``stride``-th image, counted from the newest; at most ``steps`` of the first and the final adjustment
    of the default method (of the paper's: their sum), None = the configured ones.

    As text it is the end of a window's stop reason: from there :meth:`parse` reads it again.
    """

    stride: int = 1
    steps: tuple[int, int] | None = None

    def __str__(self) -> str:
        parts = [f"every {self.stride}. image"] if self.stride > 1 else []
        if self.steps is not None:
            parts.append(f"{self.steps[0]} + {self.steps[1]} steps")
        return ", ".join(parts)

    @staticmethod
    def parse(stop_reason: str) -> Effort:
        """Effort of a window from its stop reason."""
        stride, steps = _STRIDE.search(stop_reason), _STEPS.search(stop_reason)
        return Effort(
            int(stride[1]) if stride else 1,
            (int(steps[1]), int(steps[2])) if steps else None,
        )


class EffortControl:
    """Chooses the stride of the next window from the time that the last one took.

    Parameters
    ----------
    allowed_s : for one adjustment; max_stride : the coarsest
    """

    def __init__(self, allowed_s: float, max_stride: int) -> None:
        self._allowed_s, self._max_stride = allowed_s, max_stride
        self.stride = 1

    def took(self, seconds: float) -> None:
        """Learn from an adjustment with the present stride."""
        if seconds > _TOO_LONG * self._allowed_s:
            self.stride = min(self.stride + 1, self._max_stride)
        elif self.stride > 1 and seconds * self.stride / (self.stride - 1) < _SHORT * self._allowed_s:
            self.stride -= 1
