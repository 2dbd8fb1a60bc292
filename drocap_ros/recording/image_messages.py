"""Images from messages: one message to an array, or those of a recording one at a time."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.recording.session import COMPRESSED_IMAGE, IMAGE, Message, Session, header_stamp_ns
from drocap_ros.stamps import StampValidator

if TYPE_CHECKING:
    from drocap_ros.perception.sources.base import Frame

#: Largest raw image, px.
_MAX_PIXELS = 200_000_000
# The header of a small file can declare an image of gigabytes.  OpenCV reads this limit when it is imported.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
#: Last bytes of a JPEG that must contain its end marker; cameras append padding.
_JPEG_TAIL = 4096
#: encoding -> (bytes per pixel, name of OpenCV's conversion to BGR)
_ENCODINGS: dict[str, tuple[int, str | None]] = {
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, "COLOR_RGB2BGR"),
    "bgra8": (4, "COLOR_BGRA2BGR"),
    "rgba8": (4, "COLOR_RGBA2BGR"),
    "mono8": (1, "COLOR_GRAY2BGR"),
    "8UC1": (1, "COLOR_GRAY2BGR"),
    # ROS names a Bayer pattern by its first two pixels, OpenCV by those of the second row.
    "bayer_rggb8": (1, "COLOR_BayerBG2BGR"),
    "bayer_bggr8": (1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg8": (1, "COLOR_BayerGR2BGR"),
    "bayer_grbg8": (1, "COLOR_BayerGB2BGR"),
    "yuv422": (2, "COLOR_YUV2BGR_UYVY"),
    "uyvy": (2, "COLOR_YUV2BGR_UYVY"),
    "yuv422_yuy2": (2, "COLOR_YUV2BGR_YUYV"),
    "yuyv": (2, "COLOR_YUV2BGR_YUYV"),
}


def image_from_message(message: Message, compressed: bool) -> np.ndarray:
    """(H, W, 3) uint8 BGR of a ``sensor_msgs`` Image or CompressedImage.

    Raises
    ------
    InputError
        When the encoding is unknown or the data does not fit.
    """
    data = np.ascontiguousarray(np.frombuffer(bytes(message.data), np.uint8))
    return _decompressed(data, str(message.format)) if compressed else _raw(message, data)


def read_images(session: Session) -> Iterator[Frame]:
    """Images of a recording, one at a time, with strictly increasing stamps.

    Images that do not decode, or with a stamp not later than the previous one or far from it, are left out with a
    warning.

    Raises
    ------
    InputError
        When there are no images, or none decodes.
    """
    from drocap_ros.perception.sources.base import Frame

    chosen = session.choose_topic(IMAGE, COMPRESSED_IMAGE)
    compressed = chosen.type_name == COMPRESSED_IMAGE
    last_ns, unordered, problems, stamps = None, 0, Counter[str](), StampValidator()
    for _, message in session.messages((chosen.name,)):
        stamp_ns = header_stamp_ns(message)
        try:
            stamps.check(message.header.stamp.sec, message.header.stamp.nanosec)
            if last_ns is not None and stamp_ns <= last_ns:
                unordered += 1
                continue
            image = image_from_message(message, compressed)
        except InputError as error:
            problems[str(error)] += 1
            continue
        last_ns = stamp_ns
        yield Frame(stamp_ns, image)
    if unordered:
        session.warn(f"{unordered} images on {chosen.name} with a stamp not later than the previous one were left out")
    if problems:
        worst, _ = problems.most_common(1)[0]
        session.warn(f"{sum(problems.values())} images on {chosen.name} were left out: {worst}")
        if last_ns is None:
            raise InputError(f"{session.path}: {chosen.name}: {worst}")


def _decompressed(data: np.ndarray, form: str) -> np.ndarray:
    import cv2

    image = None
    if data[:2].tobytes() == b"\xff\xd8" and b"\xff\xd9" not in data[-_JPEG_TAIL:].tobytes():
        raise InputError(f"image: expected a whole JPEG, got {data.size} bytes without its end; check the link")
    if data.size:
        try:
            image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            image = None
    if image is None:
        raise InputError(f"image: expected JPEG, PNG or another image, got format {form[:40]!r} that does not decode")
    return np.asarray(image)


def _raw(message: Message, data: np.ndarray) -> np.ndarray:
    import cv2

    height, width, step, encoding = message.height, message.width, message.step, str(message.encoding)
    if encoding not in _ENCODINGS:
        raise InputError(f"image: expected encoding {', '.join(_ENCODINGS)}, got {encoding[:40]!r}; convert it")
    size, conversion = _ENCODINGS[encoding]
    if not 0 < height * width <= _MAX_PIXELS or step < width * size or data.size < height * step:
        raise InputError(
            f"image: expected {height} rows of {step} bytes for {width}x{height} px {encoding}, got {data.size} bytes"
        )
    rows = data[: height * step].reshape(height, step)[:, : width * size]
    pixels = rows.reshape(height, width, size) if size > 1 else rows
    if conversion is None:
        return np.ascontiguousarray(pixels)
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), getattr(cv2, conversion)))
    except cv2.error:
        raise InputError(f"image: expected a size that {encoding} can have, got {width}x{height} px") from None
