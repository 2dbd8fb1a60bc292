"""Pictures as bytes: JPEG out, JPEG or PNG in."""

from __future__ import annotations

from array import array

import numpy as np

from drocap_ros.errors import InputError

#: No picture of a drone is larger; a header that claims more is not worth the memory.
MAX_PIXELS = 200_000_000


def encode_jpeg(image: np.ndarray, quality: int = 90) -> bytes:
    """JPEG bytes of an image (H, W, 3) uint8 BGR; quality 1 to 100."""
    import cv2

    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise InputError(f"image: expected (H, W, 3) uint8, got {image.dtype} {image.shape}")
    return data.tobytes()


def decode_image(data: bytes | bytearray | memoryview | array[int]) -> np.ndarray:
    """Image (H, W, 3) uint8 BGR from JPEG or PNG bytes.

    Raises
    ------
    InputError
        When the bytes are no picture.
    """
    import cv2

    raw = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(raw, cv2.IMREAD_COLOR) if raw.size else None
    if image is None:
        raise InputError(f"image: expected JPEG or PNG data, got {raw.size} bytes of something else")
    if image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise InputError(f"image: expected at most {MAX_PIXELS} pixels, got {image.shape[1]}x{image.shape[0]}")
    return image
