"""Images of the subject out of the source of a motion: few, cropped and small for a report, or all."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.motion import Motion
from drocap_ros.perception.sources import Frame, open_source
from drocap_ros.recording.image_messages import read_images
from drocap_ros.recording.open_session import is_recording, open_session

MAX_IMAGES = 300
#: Of all images together, as base64 in the page.
MAX_BYTES = 8_000_000
_LONG_SIDE = 640
_QUALITIES = (75, 60, 45, 30)
#: Margin of the crop, as a share of its size.
_MARGIN = 0.12


@dataclass(frozen=True)
class MotionImages:
    """JPEG images of some frames of a motion.

    frames : index of each image's frame in the motion, increasing
    jpegs : as many JPEG files
    box : x_min, y_min, x_max, y_max px of the crop
    size : width, height px of the JPEG images
    """

    frames: tuple[int, ...]
    jpegs: tuple[bytes, ...]
    box: tuple[int, int, int, int]
    size: tuple[int, int]


def has_images(path: Path) -> bool:
    """Whether an input of ``drocap reconstruct`` holds images for a report."""
    if path.suffix == ".npz":
        return False
    if not is_recording(path):
        return True
    with open_session(path) as session:
        return session.has_images


def read_motion_images(path: Path, motion: Motion) -> MotionImages:
    """Images of a motion out of its video, folder or recording.

    Frames are matched by their stamps; without a common clock both start with their first frame.

    Raises
    ------
    InputError
        When there are no images, or none at the motion's times.
    """
    count = min(MAX_IMAGES, len(motion.stamp_ns))
    wanted = np.unique(np.linspace(0, len(motion.stamp_ns) - 1, count).round().astype(int))
    encode = None
    frames: list[int] = []
    jpegs: list[bytes] = []
    with _opened(path) as source:
        for index, image in _matched(source, motion.stamp_ns, wanted):
            encode = encode or _Encoder(motion, image.shape, len(wanted))
            frames.append(index)
            jpegs.append(encode(image))
    if encode is None:
        raise _no_images(path)
    return MotionImages(tuple(frames), tuple(jpegs), encode.box, encode.size)


def each_image(path: Path, motion: Motion) -> Iterator[tuple[int, np.ndarray]]:
    """Index and image (H, W, 3) uint8 BGR of every frame that has one; matched as in :func:`read_motion_images`.

    Raises
    ------
    InputError
        When there are no images, or none at the motion's times.
    """
    found = False
    with _opened(path) as source:
        for index, image in _matched(source, motion.stamp_ns, np.arange(len(motion.stamp_ns))):
            found = True
            yield index, image
    if not found:
        raise _no_images(path)


def _no_images(path: Path) -> InputError:
    return InputError(f"{path}: expected images at the motion's times, found none; name the source of the motion")


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Iterable[Frame]]:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if is_recording(path):
        with open_session(path) as session:
            yield read_images(session)
    else:
        with open_source(path) as source:
            yield source


def _matched(source: Iterable[Frame], stamp_ns: np.ndarray, wanted: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Images of the wanted frames: the nearest to each stamp within half a frame."""
    half = int(np.median(np.diff(stamp_ns)) / 2) if len(stamp_ns) > 1 else 50_000_000
    waiting = [int(index) for index in wanted]
    offset: int | None = None
    before: tuple[int, np.ndarray] | None = None

    def nearest(candidates: list[tuple[int, np.ndarray] | None]) -> Iterator[tuple[int, np.ndarray]]:
        index = waiting.pop(0)
        target = int(stamp_ns[index])
        near = [c for c in candidates if c is not None and abs(c[0] - target) <= half]
        if near:
            yield index, min(near, key=lambda c: abs(c[0] - target))[1]

    for frame in source:
        if offset is None:
            elsewhere = not stamp_ns[0] - half <= frame.stamp_ns <= stamp_ns[-1] + half
            offset = int(stamp_ns[0]) - frame.stamp_ns if elsewhere else 0
        now = (frame.stamp_ns + offset, frame.image)
        while waiting and now[0] >= int(stamp_ns[waiting[0]]):
            yield from nearest([before, now])
        if not waiting:
            return
        before = now
    if waiting:
        yield from nearest([before])


class _Encoder:
    """Crops, shrinks and compresses each image into its share of the bytes."""

    def __init__(self, motion: Motion, shape: tuple[int, ...], count: int) -> None:
        height, width = shape[:2]
        self.box = _crop(motion.keypoints, width, height)
        x0, y0, x1, y1 = self.box
        scale = min(1.0, _LONG_SIDE / max(x1 - x0, y1 - y0))
        self.size = (max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale)))
        self._share = int(MAX_BYTES * 0.75 / count)

    def __call__(self, image: np.ndarray) -> bytes:
        """JPEG of an image (H, W, 3) uint8 BGR."""
        import cv2

        x0, y0, x1, y1 = self.box
        small = cv2.resize(image[y0:y1, x0:x1], self.size, interpolation=cv2.INTER_AREA)
        data = b""
        # Quality first, then size.
        for shrink in (1, 2, 4):
            size = (max(1, self.size[0] // shrink), max(1, self.size[1] // shrink))
            reduced = small if shrink == 1 else cv2.resize(small, size, interpolation=cv2.INTER_AREA)
            for quality in _QUALITIES:
                data = cv2.imencode(".jpg", reduced, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
                if len(data) <= self._share:
                    return data
        return data


def _crop(keypoints: np.ndarray, width: int, height: int) -> tuple[int, int, int, int]:
    """Bounding box of the subject over all frames, without outliers, with a margin; the whole image if unknown."""
    known = keypoints[np.isfinite(keypoints).all(axis=2)]
    if len(known) < 4:
        return 0, 0, width, height
    low, high = np.quantile(known, 0.005, axis=0), np.quantile(known, 0.995, axis=0)
    room = _MARGIN * max(float((high - low).max()), 32.0)
    x0, y0 = np.maximum(np.floor(low - room), 0).astype(int).tolist()
    x1, y1 = np.minimum(np.ceil(high + room), (width, height)).astype(int).tolist()
    if x1 - x0 < 8 or y1 - y0 < 8:
        return 0, 0, width, height
    return x0, y0, x1, y1
