"""Image files: one file, or a folder in the order of the names; encoding as JPEG."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.base import Frame, ImageSource
from drocap_ros.perception.sources.pixels import to_bgr

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})

#: Least number of digits of a file name that is a time in nanoseconds (the EuRoC and TUM convention).
_STAMP_DIGITS = 16


def read_image(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 BGR, with its EXIF orientation applied."""
    import cv2

    if not path.is_file():
        raise InputError(f"{path}: expected an image, found no such file; check the path")
    data = np.fromfile(path, np.uint8)
    try:
        # IMREAD_UNCHANGED would ignore the EXIF orientation.
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(
            f"{path}: expected an image (JPEG, PNG, TIFF, ...), found {data.size} bytes that do not decode; replace it"
        )
    return to_bgr(image)


def encode_jpeg(image: np.ndarray, quality: int = 90) -> bytes:
    """JPEG bytes of an image (H, W, 3) uint8 BGR; quality 1 to 100."""
    import cv2

    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise InputError(f"image: expected (H, W, 3) uint8, got {image.dtype} {image.shape}")
    return data.tobytes()


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts frame_2 before frame_10."""
    return [(1, int(t), "") if t.isdigit() else (0, 0, t) for t in re.split(r"(\d+)", name) if t]


class ImageFileSource(ImageSource):
    """Image files of one size.

    Stamps are the file names where these are times in nanoseconds, else ``rate_hz`` counts from 0.
    """

    def __init__(self, path: Path, rate_hz: float = 30.0) -> None:
        super().__init__()
        if path.is_dir():
            self._paths = sorted(
                (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()),
                key=lambda p: _natural(p.name),
            )
            if not self._paths:
                raise InputError(f"{path}: expected a folder with images ({', '.join(sorted(SUFFIXES))}), found none")
        else:
            self._paths = [path]
        self._stamps = _stamps(self._paths, rate_hz)
        self._first: np.ndarray | None = read_image(self._paths[0])
        self.size = (self._first.shape[1], self._first.shape[0])
        self.length = len(self._paths)
        self.duration_s = (self._stamps[-1] - self._stamps[0]) * 1e-9
        self._next = 0

    def read(self) -> Frame | None:
        """Next image, or None at the end."""
        if self._next >= len(self._paths):
            return None
        path = self._paths[self._next]
        image = self._first if self._first is not None else read_image(path)
        self._first = None
        if (image.shape[1], image.shape[0]) != self.size:
            raise InputError(
                f"{path}: expected {self.size[0]}x{self.size[1]} px like the first image, got {image.shape[1]}x"
                f"{image.shape[0]}; keep one recording per folder"
            )
        stamp = self._stamps[self._next]
        self._next += 1
        return Frame(stamp, image)

    def close(self) -> None:
        """End the iteration."""
        self._next = len(self._paths)


def _stamps(paths: list[Path], rate_hz: float) -> list[int]:
    stems = [p.stem for p in paths]
    if all(s.isdigit() and len(s) >= _STAMP_DIGITS for s in stems):
        stamps = [int(s) for s in stems]
        if all(b > a for a, b in pairwise(stamps)):
            return stamps
    return [round(i * 1e9 / rate_hz) for i in range(len(paths))]
