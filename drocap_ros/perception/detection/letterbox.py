"""A window of an image scaled into a detector's input, and boxes scaled back."""

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
    """Scale a window of the image into a canvas of ``size``, its shape kept, the rest grey.

    Parameters
    ----------
    image : (H, W, 3) uint8
    window : x_min, y_min, x_max, y_max px, inside the image
    size : (width, height) of the canvas
    centred : the picture in the middle instead of the upper left corner
    """
    import cv2

    x0, y0, x1, y1 = window
    view = image[y0:y1, x0:x1]
    scale = min(size[0] / view.shape[1], size[1] / view.shape[0])
    width, height = max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale))
    # Averaging when shrinking keeps small persons from breaking up.
    interpolation = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR
    canvas = np.full((size[1], size[0], 3), _PAD, np.uint8)
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if centred else (0, 0)
    if (width, height) == (view.shape[1], view.shape[0]):
        canvas[top : top + height, left : left + width] = view
    else:
        canvas[top : top + height, left : left + width] = cv2.resize(view, (width, height), interpolation=interpolation)
    return canvas, Letterbox(scale, (float(x0), float(y0)), (float(left), float(top)))
