"""Crop of a person, the input of a pose model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Crop:
    """Crop px = (image px + 0.5 - centre) * scale + size / 2 - 0.5, pixel centres at whole numbers."""

    centre: tuple[float, float]
    scale: float
    size: tuple[int, int]

    def to_image(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) crop px -> image px."""
        half = np.array(self.size, np.float32) / 2
        return (points + 0.5 - half) / np.float32(self.scale) + np.array(self.centre, np.float32) - 0.5


def crop_around(box: np.ndarray, size: tuple[int, int], padding: float) -> Crop:
    """Crop of ``size`` (width, height) around a box (4,) x_min y_min x_max y_max, enlarged by ``padding``."""
    x0, y0, x1, y1 = (float(v) for v in box)
    width, height = max(x1 - x0, 1.0) * padding, max(y1 - y0, 1.0) * padding
    scale = min(size[0] / width, size[1] / height)
    return Crop(((x0 + x1) / 2, (y0 + y1) / 2), scale, size)


def cut(image: np.ndarray, crop: Crop) -> np.ndarray:
    """(H, W, 3) uint8 -> crop (size[1], size[0], 3), black outside the image."""
    import cv2

    (cx, cy), scale, (width, height) = crop.centre, crop.scale, crop.size
    left, top, exact = 0, 0, np.array([1.0, 1.0])
    if scale < 0.5:
        # Bilinear sampling would skip pixels: average first, over the visible part.
        half_w, half_h = width / scale / 2, height / scale / 2
        x0, y0 = max(0, int(cx - half_w)), max(0, int(cy - half_h))
        x1, y1 = min(image.shape[1], int(cx + half_w) + 2), min(image.shape[0], int(cy + half_h) + 2)
        factor = int(1 / scale)
        view = image[y0:y1, x0:x1]
        small = (max(1, view.shape[1] // factor), max(1, view.shape[0] // factor))
        if view.size:
            left, top, exact = x0, y0, np.array([view.shape[1] / small[0], view.shape[0] / small[1]])
            image = cv2.resize(view, small, interpolation=cv2.INTER_AREA)
    matrix = np.array(
        [
            [scale * exact[0], 0, (left + 0.5 * exact[0] - cx) * scale + width / 2 - 0.5],
            [0, scale * exact[1], (top + 0.5 * exact[1] - cy) * scale + height / 2 - 0.5],
        ]
    )
    return cv2.warpAffine(image, matrix, crop.size, flags=cv2.INTER_LINEAR)
