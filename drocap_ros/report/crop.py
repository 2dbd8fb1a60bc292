"""The part of an image that a report shows: the subject and what is about it."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

#: x_min, y_min, x_max, y_max px.
Box: TypeAlias = tuple[int, int, int, int]

#: Side of the square that follows the subject, over the longer side of the keypoints' box, and the least of it, px.
_ROOM, _LEAST_SIDE = 1.6, 96.0
#: Least margin about the keypoints, as a share of their box.
_EDGE = 0.1
#: Time constant, s, of the square: it moves and grows evenly.
_LAG_S = 0.5


class FollowingBox:
    """A square about the subject, image by image in the order of time; the whole image until it was seen."""

    def __init__(self) -> None:
        self._square: np.ndarray | None = None  # (3,) centre and side, px
        self._stamp_ns = 0

    def __call__(self, stamp_ns: int, keypoints: np.ndarray, shape: tuple[int, ...]) -> Box:
        """The part of an image of a ``shape`` (H, W, ...) with keypoints (J, 2) px, NaN where unknown."""
        known = keypoints[np.isfinite(keypoints).all(axis=1)]
        if len(known) > 1:
            self._see(stamp_ns, known.min(axis=0).astype(float), known.max(axis=0).astype(float))
        if self._square is None:
            return 0, 0, shape[1], shape[0]
        side = round(float(self._square[2]))
        low = [round(float(middle - 0.5 * side)) for middle in self._square[:2]]
        x0, y0 = (max(0, min(at, most - side)) for at, most in zip(low, shape[1::-1], strict=True))
        return x0, y0, min(x0 + side, shape[1]), min(y0 + side, shape[0])

    def _see(self, stamp_ns: int, low: np.ndarray, high: np.ndarray) -> None:
        """Move towards the box of the keypoints, and at once as far as it asks for."""
        extent = float((high - low).max())
        seen = np.append(0.5 * (low + high), max(_ROOM * extent, _LEAST_SIDE))
        square = seen
        if self._square is not None:
            square = seen + np.exp((self._stamp_ns - stamp_ns) * 1e-9 / _LAG_S) * (self._square - seen)
        square[2] = max(square[2], (1 + 2 * _EDGE) * extent)
        reach = 0.5 * square[2] - _EDGE * extent
        square[:2] = np.clip(square[:2], high - reach, low + reach)
        self._square, self._stamp_ns = square, stamp_ns
