"""Windows of the image in which the detector runs."""

from __future__ import annotations

import numpy as np

Window = tuple[int, int, int, int]

#: Side of a window over the subject's longer side, and its least side in px.  In bad light, detectors of 320-416 px
#: input give a person over most of the window two to three times the score of one over a third of it.  WIDE also covers
#: the persons nearby; in CLOSE a person is as large at 256 px of input as in WIDE at 320 px; TIGHT is for a low score.
WIDE, CLOSE, TIGHT = (1.8, 416), (1.45, 208), (1.3, 160)
#: Images longer than this are also searched in tiles of this side, one per image.
_TILE = 800
#: Interval of detection over the whole image while the subject is in view.
_FULL_EVERY_NS = 1_000_000_000


class WindowSchedule:
    """Order of the windows over the whole image: at intervals all of it, without a subject parts of it in turn."""

    def __init__(self) -> None:
        #: Last detection over the whole image.
        self.full_ns: int | None = None
        self._tile = 0
        self._alternate = False
        self._turn = 0

    def full_image_due(self, stamp_ns: int) -> bool:
        """Whether the interval since the last detection over the whole image has passed."""
        return self.full_ns is None or stamp_ns - self.full_ns >= _FULL_EVERY_NS

    def search(
        self, candidates: list[np.ndarray], image_size: tuple[int, int], stamp_ns: int, single: bool
    ) -> list[Window | None]:
        """Windows without a subject: the whole image, and in turn one around each candidate's box (4,) px or a tile.

        With ``single`` whole image and others alternate.
        """
        self.full_ns = stamp_ns
        self._alternate = not self._alternate
        if single and not self._alternate:
            return [None]
        self._turn += 1
        near, tiled = [window_around(box, image_size, WIDE) for box in candidates], tiles(image_size)
        at = self._turn % (len(near) + bool(tiled)) if near or tiled else 0
        window = near[at] if at < len(near) else None
        if window is None and tiled:
            self._tile = (self._tile + 1) % len(tiled)
            window = tiled[self._tile]
        if window is None:
            return [None]
        return [window] if single else [None, window]


def window_around(box: np.ndarray, image_size: tuple[int, int], extent: tuple[float, int]) -> Window | None:
    """Window of WIDE, CLOSE or TIGHT extent around a box (4,) px; None when it would be the whole image."""
    factor, least = extent
    width, height = image_size
    side = max(factor * float(max(box[2] - box[0], box[3] - box[1])), least)
    if side >= max(width, height):
        return None
    cx, cy = float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2
    w, h = int(min(side, width)), int(min(side, height))
    x0 = int(np.clip(cx - w / 2, 0, width - w))
    y0 = int(np.clip(cy - h / 2, 0, height - h))
    return x0, y0, x0 + w, y0 + h


def tiles(image_size: tuple[int, int]) -> list[Window]:
    """Overlapping tiles that cover a large image; none for an image that fits the detector."""
    width, height = image_size
    if max(width, height) <= 1.25 * _TILE:
        return []
    side = max(_TILE, max(width, height) // 6)

    def origins(length: int) -> list[int]:
        if length <= side:
            return [0]
        count = int(np.ceil((length - side) / (0.75 * side))) + 1
        return [round(i * (length - side) / (count - 1)) for i in range(count)]

    return [(x, y, min(x + side, width), min(y + side, height)) for y in origins(height) for x in origins(width)]


def uncut(boxes: np.ndarray, window: Window | None, image_size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: boxes that no edge of the window cuts; edges of the image do not count."""
    if window is None:
        return np.ones(len(boxes), bool)
    x0, y0, x1, y1 = window
    width, height = image_size
    margin = 2.0
    return (
        ((boxes[:, 0] > x0 + margin) | (x0 == 0))
        & ((boxes[:, 1] > y0 + margin) | (y0 == 0))
        & ((boxes[:, 2] < x1 - margin) | (x1 == width))
        & ((boxes[:, 3] < y1 - margin) | (y1 == height))
    )
