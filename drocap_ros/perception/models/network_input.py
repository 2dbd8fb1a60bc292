"""An image as a network's input: letterbox of a window, crop of a person, normalization; and the way back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.models.spec import ModelSpec

#: Grey of a letterbox's margins, as in the training of YOLOX and RTMDet.
_GREY = 114


@dataclass(frozen=True)
class InputPlace:
    """Place of a network's input (width, height) px in an image: its px = (image px - origin) * scale + offset."""

    origin: tuple[float, float]
    scale: float
    offset: tuple[float, float]
    size: tuple[int, int]

    def to_image(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) input px -> image px."""
        return (points - np.array(self.offset, np.float32)) / np.float32(self.scale) + np.array(self.origin, np.float32)


def letterbox(
    image: np.ndarray, window: tuple[int, int, int, int], size: tuple[int, int], centred: bool = False
) -> tuple[np.ndarray, InputPlace]:
    """Scale a window of the image into a canvas of ``size`` at its aspect ratio; the rest is grey.

    image : (H, W, 3) uint8
    window : x_min, y_min, x_max, y_max px, inside the image
    size : (width, height) of the canvas
    centred : window in the middle of the canvas instead of the upper left corner
    """
    x0, y0, x1, y1 = window
    view = image[y0:y1, x0:x1]
    scale = min(size[0] / view.shape[1], size[1] / view.shape[0])
    width, height = max(1, round(view.shape[1] * scale)), max(1, round(view.shape[0] * scale))
    canvas = np.full((size[1], size[0], 3), _GREY, np.uint8)
    left, top = ((size[0] - width) // 2, (size[1] - height) // 2) if centred else (0, 0)
    canvas[top : top + height, left : left + width] = shrink(view, (width, height))
    return canvas, InputPlace((float(x0), float(y0)), scale, (float(left), float(top)), size)


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


def crop_around(box: np.ndarray, size: tuple[int, int], padding: float) -> InputPlace:
    """Crop of ``size`` (width, height) around a box (4,) x_min y_min x_max y_max, enlarged by ``padding``.

    The middle of the crop is that of the box; centres of pixels are at whole numbers.
    """
    x0, y0, x1, y1 = (float(v) for v in box)
    width, height = max(x1 - x0, 1.0) * padding, max(y1 - y0, 1.0) * padding
    scale = min(size[0] / width, size[1] / height)
    middle = (x0 + x1) / 2 - 0.5, (y0 + y1) / 2 - 0.5
    return InputPlace(middle, scale, (size[0] / 2 - 0.5, size[1] / 2 - 0.5), size)


def cut(image: np.ndarray, crop: InputPlace) -> np.ndarray:
    """(H, W, 3) uint8 -> crop (size[1], size[0], 3), black outside the image."""
    import cv2

    (cx, cy), scale, (width, height) = np.add(crop.origin, 0.5), crop.scale, crop.size
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


class Normalizer:
    """(x - mean) / std by a table of 256 entries per channel: one pass, no intermediate float image."""

    def __init__(self, spec: ModelSpec) -> None:
        mean, std = np.array(spec.mean, np.float32), np.array(spec.std, np.float32)
        values = np.arange(256, dtype=np.float32)
        self._table = ((values[None] - mean[:, None]) / std[:, None]).astype(np.float32)
        self._plain = bool((mean == 0).all() and (std == 1).all())
        self._order = (2, 1, 0) if spec.colour == "rgb" else (0, 1, 2)
        self._channels_last = spec.channels_last

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (1, 3, H, W) or (1, H, W, 3) float32 (uint8 without scaling)."""
        if self._channels_last:
            ordered = np.ascontiguousarray(image[..., self._order])[None]
            if self._plain:
                return ordered
            return np.stack([self._table[c][ordered[..., c]] for c in range(3)], -1)
        out = np.empty((1, 3, *image.shape[:2]), np.float32)
        for place, channel in enumerate(self._order):
            np.take(self._table[place], image[..., channel], out=out[0, place], mode="clip")
        return out
