"""Pixels of any encoding to BGR of 8 bits; image files: one, or a folder in the order of the names."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind

logger = logging.getLogger(__name__)

Image = TypeVar("Image")

# The header of a small file can declare an image of gigabytes.  OpenCV reads this limit when it is imported.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
#: Largest raw image, px.
_MAX_PIXELS = 200_000_000
#: Last bytes of a JPEG that must contain its end marker; cameras append padding.
_JPEG_TAIL = 4096
#: Percentiles of a 16-bit image that become black and white: a thermal camera or a sensor of 12 bits uses a small part
#: of the range, a few dead pixels all of it.
_BLACK_WHITE = (0.5, 99.5)
#: Every such pixel of a row and of a column counts for them.
_SAMPLING = 4
#: order of the colours -> (samples per pixel, name of OpenCV's conversion to BGR); bits follow the name
_ORDERS: dict[str, tuple[int, str | None]] = {
    "bgr": (3, None),
    "rgb": (3, "COLOR_RGB2BGR"),
    "bgra": (4, "COLOR_BGRA2BGR"),
    "rgba": (4, "COLOR_RGBA2BGR"),
    "mono": (1, "COLOR_GRAY2BGR"),
    # ROS names a Bayer pattern by its first two pixels, OpenCV by those of the second row.
    "bayer_rggb": (1, "COLOR_BayerBG2BGR"),
    "bayer_bggr": (1, "COLOR_BayerRG2BGR"),
    "bayer_gbrg": (1, "COLOR_BayerGR2BGR"),
    "bayer_grbg": (1, "COLOR_BayerGB2BGR"),
}
_OF_CHANNELS = {"1": "mono", "3": "bgr", "4": "bgra"}
#: Two bytes per pixel, interleaved.
_PACKED = dict.fromkeys(("yuv422", "uyvy"), "COLOR_YUV2BGR_UYVY")
_PACKED |= dict.fromkeys(("yuv422_yuy2", "yuyv", "yuy2"), "COLOR_YUV2BGR_YUYV")
#: Luma, then chroma of half the rows.
_PLANAR = {"nv12": "NV12", "nv21": "NV21", "i420": "I420", "yuv420": "I420", "yuv420p": "I420", "yv12": "YV12"}
_NAMED = re.compile(r"(bgra?|rgba?|mono|gr[ae]y|y|bayer_[rgb]{4})_?(8|10|12|14|16)?")
_GREYS = dict.fromkeys(("gray", "grey", "y"), "mono")
_TYPED = re.compile(r"(8U|16U|32F)C([134])")
_DEPTH = re.compile(r"16[US]C1|32FC1|64FC1|.*compressedDepth.*")
_GREY = re.compile(r"mono|8UC1")


def colour_rank(encoding: str) -> int:
    """0 of an encoding or format with colours, 1 of grey, 2 of mostly distances; some thermal cameras use those too."""
    return 2 if _DEPTH.match(encoding) else int(bool(_GREY.match(encoding)))


def to_bgr(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 BGR from a grey, alpha, 16-bit or float image."""
    if image.dtype != np.uint8:
        image = _eight_bits(image)
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] in (1, 2):  # grey, grey + alpha
        image = np.repeat(image[..., :1], 3, axis=2)
    return np.ascontiguousarray(image[..., :3])


def _eight_bits(image: np.ndarray) -> np.ndarray:
    """The range of an image's values, or 0 to 1 of floats, spread over 0 to 255; one value alone keeps its share."""
    full = 1.0 if image.dtype.kind == "f" else float(np.iinfo(image.dtype).max)
    values = np.nan_to_num(image.astype(np.float32), posinf=0.0, neginf=0.0)
    low, high = np.percentile(values[::_SAMPLING, ::_SAMPLING], _BLACK_WHITE)
    if high <= low or (full == 1.0 and low >= 0.0 and high <= 1.0):
        low, high = 0.0, full
    spread: np.ndarray = (values - low) * (255.0 / (high - low)) + 0.5
    return np.clip(spread, 0, 255).astype(np.uint8)


def decoded(data: np.ndarray, form: str) -> np.ndarray:
    """(H, W, 3) uint8 BGR of a JPEG, PNG or other image in memory; ``form`` is its stated format."""
    import cv2

    if data[:2].tobytes() == b"\xff\xd8" and b"\xff\xd9" not in data[-_JPEG_TAIL:].tobytes():
        raise InputError(f"image: expected a whole JPEG, got {data.size} bytes without its end; check the link")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:
        image = None
    if image is None:
        raise InputError(f"image: expected JPEG, PNG or another image, got format {form[:40]!r} that does not decode")
    pixels, named = to_bgr(np.asarray(image)), _NAMED.match(form.strip().lower())
    if named and named[1].startswith("bayer") and (pixels[..., :1] == pixels).all():  # a sensor's mosaic as grey
        return np.asarray(cv2.cvtColor(pixels[..., 0], getattr(cv2, str(_ORDERS[named[1]][1]))))
    return pixels


def raw_to_bgr(data: np.ndarray, size: tuple[int, int], step: int, encoding: str, big_endian: bool) -> np.ndarray:
    """(H, W, 3) uint8 BGR of the bytes of a raw image.

    data : (N,) uint8
    size : (width, height) px
    step : bytes per row
    encoding : as ROS names them, also planar YUV
    big_endian : order of the bytes of a sample
    """
    import cv2

    try:
        if encoding.lower() in _PLANAR:
            return _planar(data, size, step, encoding.lower())
        return _interleaved(data, size, step, encoding, big_endian)
    except cv2.error:
        raise InputError(f"image: expected a size that {encoding} can have, got {size[0]}x{size[1]} px") from None


def _rows(data: np.ndarray, shape: tuple[int, int], step: int, words: str) -> np.ndarray:
    """(rows, bytes) of data whose rows are ``step`` bytes apart."""
    rows, width = shape
    step = step or width  # as some drivers leave it
    if not 0 < rows * width <= _MAX_PIXELS * 16 or step < width or data.size < rows * step:
        raise InputError(f"image: expected {rows} rows of {step} bytes for {words}, got {data.size} bytes")
    return data[: rows * step].reshape(rows, step)[:, :width]


def _planar(data: np.ndarray, size: tuple[int, int], step: int, encoding: str) -> np.ndarray:
    import cv2

    (width, height), words = size, f"{size[0]}x{size[1]} px {encoding}"
    rows = height + (height + 1) // 2
    step = step if step >= width and data.size >= rows * step else width  # some state the bytes of all planes
    planes = np.ascontiguousarray(_rows(data, (rows, width), step, words))
    return np.asarray(cv2.cvtColor(planes, getattr(cv2, f"COLOR_YUV2BGR_{_PLANAR[encoding]}")))


def _interleaved(data: np.ndarray, size: tuple[int, int], step: int, encoding: str, big_endian: bool) -> np.ndarray:
    import cv2

    count, conversion, kind = _layout(encoding)
    (width, height), words = size, f"{size[0]}x{size[1]} px {encoding}"
    kind = kind.newbyteorder(">" if big_endian else "<")
    rows = np.ascontiguousarray(_rows(data, (height, width * count * kind.itemsize), step, words)).view(kind)
    pixels = rows.reshape(height, width, count) if count > 1 else rows
    if kind.itemsize > 1:
        pixels = _eight_bits(pixels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, getattr(cv2, conversion)))


def _layout(encoding: str) -> tuple[int, str | None, np.dtype]:
    """Samples per pixel, conversion, and type of a sample."""
    if encoding.lower() in _PACKED:
        return 2, _PACKED[encoding.lower()], np.dtype("u1")
    if typed := _TYPED.fullmatch(encoding):
        order, kind = _OF_CHANNELS[typed[2]], {"8U": "u1", "16U": "u2", "32F": "f4"}[typed[1]]
    elif (named := _NAMED.fullmatch(encoding.strip().lower())) and (order := _GREYS.get(named[1], named[1])) in _ORDERS:
        kind = "u1" if named[2] in (None, "8") else "u2"
    else:
        known = (*(f"{name}8 or 16" for name in _ORDERS), *_PACKED, *_PLANAR, "8UC3 and the like")
        raise InputError(f"image: expected encoding {', '.join(known)}, got {encoding[:40]!r}; convert it")
    return *_ORDERS[order], np.dtype(kind)


SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"})

#: A time at the end of a name: seconds with their fraction (TUM), or ms, us or ns as one number (EuRoC, Kalibr).
_TIME = re.compile(r"(?:^|\D)(?:(\d{9,10})(?:\.(\d{3,9})|_(\d{9}))|(\d{13,19}))$")
#: A name's begin, number and end.
_NUMBERED = re.compile(r"(.*?)(\d*)(\D*)")
#: Names of what is no picture of a camera.
NO_PICTURE = re.compile(r"depth|disparity|mask|label|segment|confidence", re.IGNORECASE)


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


def natural(name: object) -> list[tuple[int, int, str]]:
    """Sort key that puts frame_2 before frame_10."""
    return [(1, int(t), "") if t.isdigit() else (0, 0, t) for t in re.split(r"(\d+)", str(name)) if t]


class ImageFileSource(ImageSource):
    """Image files of one size.

    Stamps are the times in the files' names, else ``rate_hz`` and their numbers count from 0.  Files of a folder that
    do not decode are gaps, and a ``DAMAGED`` event follows at the end.
    """

    def __init__(self, path: Path, rate_hz: float = 30.0) -> None:
        super().__init__()
        if path.is_dir():
            there = sorted(path.glob("[!.]*"), key=lambda p: natural(p.name))
            images = [p for p in there if p.suffix.lower() in SUFFIXES and p.is_file()]
            self._paths, words = of_one_recording(images, [p.name for p in images])
            if words:
                logger.warning("%s: %s", path, words)
            if not self._paths:
                found = ", ".join(dict.fromkeys(p.suffix or f"{p.name}/" for p in there)) or "none"
                raise InputError(
                    f"{path}: expected a folder with images ({', '.join(sorted(SUFFIXES))}), found {found}; name one of"
                    " its videos or folders, or convert its files"
                )
        else:
            if _pictures_in(path) > 1:
                raise InputError(
                    f"{path}: expected one picture, found {_pictures_in(path)} in one file; convert it: ffmpeg -i IN"
                    " OUT.mp4, or the pages to files of a folder"
                )
            self._paths = [path]
        self._stamps = _stamps(self._paths, rate_hz)
        self._next, self._damaged = 0, list[Path]()
        self._first = self._decode()
        if self._first is None:
            raise InputError(
                f"{self._damaged[0]}: expected an image (JPEG, PNG, TIFF, ...), found"
                f" {self._damaged[0].stat().st_size} bytes that do not decode; replace it"
            )
        self.size = (self._first.shape[1], self._first.shape[0])
        self.length = len(self._paths)
        self.duration_s = (self._stamps[-1] - self._stamps[0]) * 1e-9

    def _decode(self) -> np.ndarray | None:
        """The next image that decodes, whose place ``_next`` then is; None at the end."""
        while self._next < len(self._paths):
            try:
                return read_image(self._paths[self._next])
            except InputError:  # noqa: PERF203  # few are damaged
                self._damaged.append(self._paths[self._next])
                self._next += 1
        return None

    def read(self) -> Frame | None:
        """Next image, or None at the end."""
        image, self._first = self._first if self._first is not None else self._decode(), None
        if image is None:
            if self._damaged:
                words = f"images that do not decode: {len(self._damaged)}, as {self._damaged[0].name}"
                event = SourceEvent(SourceEventKind.DAMAGED, str(self._damaged[0].parent), words)
                self._events.append(event)
                logger.warning(str(event))
                self._damaged = []
            return None
        path = self._paths[self._next]
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
    """Times of the images, ns: those in their names, else their numbers, in even steps, by the rate."""
    found = [match.groups() for p in paths if (match := _TIME.search(p.stem))]
    times = [int(whole) if whole else int(s + (fraction or ns).ljust(9, "0")) for s, fraction, ns, whole in found]
    if len(times) == len(paths) > 1 and all(b > a for a, b in pairwise(times)):
        step = float(np.median(np.diff(times)))
        for unit_ns in (1, 10**3, 10**6):
            if 1e6 <= step * unit_ns <= 1e10:  # of a camera
                return [time * unit_ns for time in times]
    numbers = [int(number) for p in paths if (number := _NUMBERED.fullmatch(p.stem.lower())[2])]  # type: ignore[index]
    steps = [b - a for a, b in pairwise(numbers)]
    # Of frames' numbers most follow each other.
    if len(numbers) == len(paths) > 1 and min(steps) > 0 and 2 * steps.count(least := math.gcd(*steps)) > len(steps):
        return [round((number - numbers[0]) // least * 1e9 / rate_hz) for number in numbers]
    return [round(i * 1e9 / rate_hz) for i in range(len(paths))]


def of_one_recording(images: list[Image], names: list[str]) -> tuple[list[Image], str]:
    """The images of the recording with most of them, and words on others, where names differ not by a number alone.

    Such are two cameras, masks or depths beside the pictures, or each picture in two formats.
    """
    kinds: dict[tuple[str, str], list[Image]] = {}
    for image, name in zip(images, names, strict=True):
        begin, _, end = _NUMBERED.fullmatch(name.lower()).groups()  # type: ignore[union-attr]
        # Six digits before the last number are a date or a time.
        kinds.setdefault(("" if sum(map(str.isdigit, begin)) >= 6 else begin, end), []).append(image)
    if len(kinds) < 2 or len(kinds) > len(images) / 4:  # else names have nothing in common
        return images, ""
    best = min(kinds, key=lambda kind: (bool(NO_PICTURE.search("".join(kind))), -len(kinds[kind])))
    there = ", ".join(f"{begin}*{end} ({len(of)})" for (begin, end), of in kinds.items())
    return kinds[best], f"several recordings, {there}: {'*'.join(best)} is used, another where it is alone"


def is_mjpeg(path: Path) -> bool:
    """Whether a file holds JPEG images one after the other, as simple cameras write them: a video without a container.

    Cameras append a preview to a picture: two are none.
    """
    return path.is_file() and path.read_bytes().count(b"\xff\xd9\xff\xd8\xff") > 1


def _pictures_in(path: Path) -> int:
    """Number of pages or of pictures of an animation in one file; 0 of one that OpenCV does not read."""
    import cv2

    with contextlib.suppress(cv2.error):
        return int(cv2.imcount(str(path), cv2.IMREAD_UNCHANGED))
    return 0
