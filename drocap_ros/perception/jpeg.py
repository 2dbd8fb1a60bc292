"""JPEG encoding of images."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError


def encode_jpeg(image: np.ndarray, quality: int = 90) -> bytes:
    """JPEG bytes of an image (H, W, 3) uint8 BGR; quality 1 to 100."""
    import cv2

    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise InputError(f"image: expected (H, W, 3) uint8, got {image.dtype} {image.shape}")
    return data.tobytes()
