"""Letterbox: an image window scaled into a detector's input, and boxes scaled back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_PAD = 114


@dataclass(frozen=True)
class Letterbox:
    """Input px = (image px - origin) * scale + offset."""

    scale: float
    origin: tuple[float, float]
    offset: tuple[float, float]

    def to_image(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) input px -> image px."""
        return (points - np.array(self.offset, np.float32)) / np.float32(self.scale) + np.array(self.origin, np.float32)

    def boxes_to_image(self, boxes: np.ndarray) -> np.ndarray:
        """(N, 4) x_min y_min x_max y_max."""
        return self.to_image(boxes.reshape(-1, 2, 2)).reshape(-1, 4)


def letterbox(
    image: np.ndarray, window: tuple[int, int, int, int], size: tuple[int, int], centred: bool = False
) -> tuple[np.ndarray, Letterbox]:
    """Scale a window of the image into a canvas of ``size`` at its aspect ratio; the rest is grey.

    Parameters
    ----------
    image : (H, W, 3) uint8
    window : x_min, y_min, x_max, y_max px, inside the image
    size : (width, height) of the canvas
    centred : window in the middle of the canvas instead of the upper left corner
    """
    x0, y0, x1, y1 = window
    view = image[y0:y1, x0:x1]
    scale = min(size[0] / view.shape[1], size[1] / view.shape[0])
    width, height = max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale))
    canvas = np.full((size[1], size[0], 3), _PAD, np.uint8)
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if centred else (0, 0)
    canvas[top : top + height, left : left + width] = shrink(view, (width, height))
    return canvas, Letterbox(scale, (float(x0), float(y0)), (float(left), float(top)))


def shrink(view: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Image at another ``size`` (width, height): averaged over whole pixels first, then interpolated.

    Averaging avoids aliasing of small persons; over whole pixels it costs a tenth of an exact area mean.
    """
    import cv2

    factor = min(view.shape[1] // size[0], view.shape[0] // size[1])
    if factor >= 2:
        rows, columns = view.shape[0] // factor, view.shape[1] // factor
        # The remainder at the right and bottom edge, less than ``factor`` pixels, is left out.
        exact = view[: rows * factor, : columns * factor]
        view = cv2.resize(exact, (columns, rows), interpolation=cv2.INTER_AREA)
    if (view.shape[1], view.shape[0]) == size:
        return view
    return cv2.resize(view, size, interpolation=cv2.INTER_LINEAR)
