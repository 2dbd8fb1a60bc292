"""Conversion of a BGR image into a model's input tensor."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.models.spec import ModelSpec


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
