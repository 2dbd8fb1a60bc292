"""Where to look for persons in the next image."""

from __future__ import annotations

import numpy as np

Window = tuple[int, int, int, int]

#: Side of the window over the subject's longer side, and its least side in px.  Detectors of 320-416 px input
#: score a person in bad light two to three times higher who fills most of the window than one who fills a
#: third; the wider window shows who else is near.
_WIDE, _WIDE_LEAST = 1.8, 416
_TIGHT, _TIGHT_LEAST = 1.3, 160
#: In a hurry: the person is as large in a network's input of 256 px as in one of 320 px by the wide window.
_QUICK, _QUICK_LEAST = 1.45, 208
#: Images longer than this are also searched in tiles of this side, one an image.
_TILE = 800


def window_around(
    box: np.ndarray, image_size: tuple[int, int], tight: bool = False, quick: bool = False
) -> Window | None:
    """Square window around a box, moved into the image; None when it would be the whole image anyway."""
    width, height = image_size
    factor, least = (_TIGHT, _TIGHT_LEAST) if tight else (_QUICK, _QUICK_LEAST) if quick else (_WIDE, _WIDE_LEAST)
    side = max(factor * float(max(box[2] - box[0], box[3] - box[1])), least)
    if side >= max(width, height):
        return None
    cx, cy = float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2
    w, h = int(min(side, width)), int(min(side, height))
    x0 = int(np.clip(cx - w / 2, 0, width - w))
    y0 = int(np.clip(cy - h / 2, 0, height - h))
    return x0, y0, x0 + w, y0 + h


def tiles(image_size: tuple[int, int]) -> list[Window]:
    """Overlapping tiles that cover a large image; none for one that the detector takes in at a glance."""
    width, height = image_size
    if max(width, height) <= 1.25 * _TILE:
        return []
    side = max(_TILE, max(width, height) // 6)

    def starts(length: int) -> list[int]:
        if length <= side:
            return [0]
        count = int(np.ceil((length - side) / (0.75 * side))) + 1
        return [round(i * (length - side) / (count - 1)) for i in range(count)]

    return [(x, y, min(x + side, width), min(y + side, height)) for y in starts(height) for x in starts(width)]


def inside(boxes: np.ndarray, window: Window | None, image_size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: boxes that do not touch an edge of the window which is no edge of the image."""
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
