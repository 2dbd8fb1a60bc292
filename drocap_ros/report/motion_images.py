"""Images of the subject out of the source of a motion: few, cropped and small for a report, or all."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.errors import InputError
from drocap_ros.geometry.interpolation import usual_step
from drocap_ros.keypoints import PoseObservation
from drocap_ros.motion import Motion
from drocap_ros.open_images import Images, open_images
from drocap_ros.perception.models.network_input import shrink
from drocap_ros.perception.sources import Frame
from drocap_ros.perception.sources.base import prefetch
from drocap_ros.recording.open_session import is_recording, open_session
from drocap_ros.recording.session import IMAGES
from drocap_ros.tracks import Tracks

#: x_min, y_min, x_max, y_max px.
Box: TypeAlias = tuple[int, int, int, int]

#: Side of the square that follows the subject, over the longer side of the keypoints' box, and the least of it, px.
_ROOM, _LEAST_SIDE = 1.6, 96.0
#: Least margin about the keypoints, as a share of their box.
_EDGE = 0.1


class FollowingBox:
    """A square about the subject, image by image in the order of time; the whole image until it was seen."""

    def __init__(self) -> None:
        self._square: np.ndarray | None = None  # (3,) centre and side, px
        self._stamp_ns = 0

    def __call__(self, stamp_ns: int, keypoints: np.ndarray, shape: tuple[int, ...]) -> Box:
        """The part of an image of a ``shape`` (H, W, ...) with keypoints (J, 2) px, NaN where unknown."""
        known = keypoints[np.isfinite(keypoints).all(axis=1)]
        if len(known) > 1:
            self._see(stamp_ns, known.min(axis=0).astype(float), known.max(axis=0).astype(float))
        if self._square is None:
            return 0, 0, shape[1], shape[0]
        side = round(float(self._square[2]))
        low = [round(float(middle - 0.5 * side)) for middle in self._square[:2]]
        x0, y0 = (max(0, min(at, most - side)) for at, most in zip(low, shape[1::-1], strict=True))
        return x0, y0, min(x0 + side, shape[1]), min(y0 + side, shape[0])

    def _see(self, stamp_ns: int, low: np.ndarray, high: np.ndarray) -> None:
        """Move towards the box of the keypoints, and at once as far as it asks for."""
        extent = float((high - low).max())
        seen = np.append(0.5 * (low + high), max(_ROOM * extent, _LEAST_SIDE))
        square = seen
        if self._square is not None:
            # The square moves and grows evenly, in half a second.
            square = seen + np.exp((self._stamp_ns - stamp_ns) * 1e-9 / 0.5) * (self._square - seen)
        square[2] = max(square[2], (1 + 2 * _EDGE) * extent)
        reach = 0.5 * square[2] - _EDGE * extent
        square[:2] = np.clip(square[:2], high - reach, low + reach)
        self._square, self._stamp_ns = square, stamp_ns


#: Most images in a report, and bytes of all together, as base64: the page stays quick to open and to mail.
MAX_IMAGES = 300
MAX_BYTES = 8_000_000  # bytes; mail often ends at 10 MB
#: How an image is compressed, the best first: at a share of that size and a quality.
_STEPS = tuple((share, quality) for share in (1, 2, 4) for quality in (75, 60, 45, 30))
#: Growth of the bytes by a step up, of three videos at least 1.13, until a video has shown its own: a step that cannot
#: fit is not tried.
_GROWTH = 1.12
#: Most images that are kept while their poses are found, 60 MB: the report of a longer recording reads it again.
_MOST_KEPT = 3000
#: Tolerance of the checks whether images belong to a motion: their number (re-encoding loses a few), their rate, and
#: the share of keypoints outside of them (networks place a few joints beyond the edge); a judgement.
_OTHERWISE = 0.03


@dataclass(frozen=True)
class MotionImages:
    """JPEG images of some frames of a motion.

    frames : index of each image's frame in the motion, increasing
    jpegs : as many JPEG files
    boxes : as many crops, of which they are
    """

    frames: tuple[int, ...]
    jpegs: tuple[bytes, ...]
    boxes: tuple[Box, ...]


class ShownTracks(NamedTuple):
    """What says which images are a motion's, and where its subject is in them; fields as of ``Motion``."""

    stamp_ns: np.ndarray
    keypoints: np.ndarray
    meta: Mapping[str, object]


Shown: TypeAlias = Motion | ShownTracks


class ImagesBeside(AbstractContextManager["ImagesBeside"]):
    """The images of a motion, kept while its poses are found, else read in another thread while it is computed.

    path : source of the motion; None = it has no images
    waiting : most images that wait for the thread that compresses them; 0 = it has none of its own
    """

    def __init__(self, path: Path | None, progress: Progress, waiting: int = 4) -> None:
        self._path, self._progress, self._waiting = path, progress, waiting
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="images")
        self._stop = threading.Event()
        self._read: Future[MotionImages] | None = None
        self._encode, self._follow = _Encoder(), FollowingBox()
        self._keeps, self._kept = path is not None, list[Future[tuple[bytes, Box]]]()

    def keep(self, frame: Frame, observation: PoseObservation) -> None:
        """Keep an image, in the order of time, as its pose was found: the motion's row of its number."""
        if len(self._kept) == _MOST_KEPT:
            self._keeps, self._kept = False, []
        if not self._keeps:
            return
        box = self._follow(frame.stamp_ns, observation.keypoints, frame.image.shape)
        self._kept.append(self._pool.submit(self._compressed, frame.image, box))
        if len(self._kept) > self._waiting:
            self._kept[-1 - self._waiting].result()

    def _compressed(self, image: np.ndarray, box: Box) -> tuple[bytes, Box]:
        return self._encode(image, box), box

    def begin(self, tracks: Tracks | Motion, meta: Mapping[str, object]) -> None:
        """Begin to read, as soon as the motion's tracks and what its ``meta`` says of the images are known."""
        if self._path is not None and self._kept_of(tracks) is None:
            shown = ShownTracks(tracks.stamp_ns, tracks.keypoints, meta)
            self._read = self._pool.submit(read_motion_images, self._path, shown, self._unless_stopped)

    def of(self, motion: Motion) -> MotionImages | None:
        """The images of the motion; they are read now where they were not kept, and nobody has begun."""
        if self._read is None:
            self.begin(motion, motion.meta)
        if self._read is not None:
            return self._read.result()
        self._progress("report", 1.0)
        return self._kept_of(motion)

    def _kept_of(self, tracks: Tracks | Motion) -> MotionImages | None:
        """The kept images; None where they are not one for each row, as of a recording that holds its poses."""
        if len(self._kept) != len(tracks.stamp_ns):
            return None
        rows = _wanted(len(self._kept))
        jpegs, boxes = zip(*(self._kept[row].result() for row in rows), strict=True)
        return MotionImages(tuple(rows), jpegs, boxes)

    def _unless_stopped(self, stage: str, done: float) -> None:
        if self._stop.is_set():
            raise CancelledError
        self._progress(stage, done)

    def __exit__(self, *_: object) -> None:
        """End the thread, after a failure before its last image."""
        self._stop.set()
        self._pool.shutdown()


def has_images(path: Path) -> bool:
    """Whether an input of ``drocap reconstruct`` holds images for a report."""
    if path.suffix == ".npz":
        return False
    if not is_recording(path):
        return True
    with open_session(path) as session:
        return bool(session.topics_of(*IMAGES))


def read_motion_images(path: Path, motion: Shown, progress: Progress | None = None) -> MotionImages:
    """Images of a motion out of its video, folder or recording.

    Frames are matched by their stamps; without a common clock both start with their first frame.
    """
    encode, follow = _Encoder(), FollowingBox()
    found: list[tuple[int, bytes, Box]] = []
    with _opened(path, motion) as source:
        for index, image in _matched(source, motion, _wanted(len(motion.stamp_ns))):
            for row in range(found[-1][0] + 1 if found else 0, index + 1):
                box = follow(int(motion.stamp_ns[row]), motion.keypoints[row], image.shape)
            found.append((index, encode(image, box), box))
            if progress is not None:
                progress("report", (index + 1) / len(motion.stamp_ns))
    if not found:
        raise _no_images(path)
    return MotionImages(*zip(*found, strict=True))


def _wanted(length: int) -> list[int]:
    """The frames of a motion that have an image in the report."""
    wanted: list[int] = np.unique(np.linspace(0, length - 1, min(MAX_IMAGES, length)).round().astype(int)).tolist()
    return wanted


def each_image(path: Path, motion: Shown) -> Iterator[tuple[int, np.ndarray]]:
    """Index and image (H, W, 3) uint8 BGR of every frame that has one; matched as in :func:`read_motion_images`."""
    found = False
    with _opened(path, motion) as source:
        for index, image in _matched(source, motion, range(len(motion.stamp_ns))):
            found = True
            yield index, image
    if not found:
        raise _no_images(path)


def _no_images(path: Path) -> InputError:
    return InputError(f"{path}: expected images at the motion's times, found none; name the source of the motion")


@contextlib.contextmanager
def _opened(path: Path, motion: Shown) -> Iterator[Images]:
    """Images of a path; refused when they cannot be those of the motion."""
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    topic = str(_stated(motion, "images").get("topic", ""))
    topic = topic if is_recording(path) or path.name == motion.meta.get("input") else ""
    with open_images(path, topic=topic) as images:
        if not is_recording(path):  # a recording may hold more images than poses, with the same clock
            _check_times(path, images, motion)
        with contextlib.closing(prefetch(images.frames)) as frames:
            yield images._replace(frames=_checked_sizes(path, frames, motion))


def _check_times(path: Path, images: Images, motion: Shown) -> None:
    """Refuse images of another number or rate than ``meta`` states, or else that cannot be at the motion's times."""
    stated = _stated(motion, "images")
    for expected, got, share, slack, words in (
        (stated.get("length"), images.length, _OTHERWISE, 1, "images"),
        (stated.get("rate_hz"), images.rate_hz, _OTHERWISE, 0, "images per second"),
    ):
        if isinstance(expected, int | float) and got and abs(got - expected) > share * expected + slack:
            raise _other(path, f"{expected:.4g} {words}", f"{got:.4g}")
    _check_span(path, images, motion)


def _check_span(path: Path, images: Images, motion: Shown) -> None:
    """Refuse images whose rate or duration does not fit the motion's stamps, where ``meta`` states no number."""
    stated = _stated(motion, "images")
    if stated.get("length") or images.rate_hz is None or images.duration_s is None or len(motion.stamp_ns) < 2:
        return
    step_s = usual_step(motion.stamp_ns) * 1e-9
    ratio = step_s * images.rate_hz  # images per frame of the motion
    if ratio < 0.5 or abs(ratio - round(ratio)) > _OTHERWISE * ratio:
        raise _other(path, f"{1 / step_s:.4g} images per second or a multiple", f"{images.rate_hz:.4g}")
    length_ns = int(motion.stamp_ns[-1] - motion.stamp_ns[0])
    if length_ns > 1e9 * images.duration_s + _slack_ns(length_ns):
        raise _other(path, f"at least {length_ns * 1e-9:.1f} s", f"{images.duration_s:.1f} s")


def _checked_sizes(path: Path, frames: Iterable[Frame], motion: Shown) -> Iterator[Frame]:
    """The frames; refused when the first has another size than the images of the motion."""
    for number, frame in enumerate(frames):
        if number == 0:
            _check_size(path, frame.image.shape[1], frame.image.shape[0], motion)
        yield frame


def _check_size(path: Path, width: int, height: int, motion: Shown) -> None:
    if size := _stated(motion, "images").get("size"):
        if size != [width, height]:
            raise _other(path, f"size {size} px", f"{width}x{height} px")
        return
    known = motion.keypoints[np.isfinite(motion.keypoints).all(axis=2)]
    outside = float(((known < 0) | (known > (width, height))).any(axis=1).mean()) if len(known) else 0.0
    if outside > _OTHERWISE:
        raise _other(path, "its keypoints inside the images", f"{outside:.0%} of them outside {width}x{height} px")


def _stated(motion: Shown, name: str) -> dict[str, object]:
    """An entry of ``meta`` that is a table; empty where it is none."""
    value = motion.meta.get(name)
    return value if isinstance(value, dict) else {}


def _other(path: Path, expected: str, found: str) -> InputError:
    return InputError(f"{path}: expected the images of this motion with {expected}, found {found}; name its own video")


def _matched(images: Images, motion: Shown, wanted: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
    """Images of the wanted frames: the nearest to each stamp within half a frame."""
    stamp_ns = motion.stamp_ns
    half = int(np.median(np.diff(stamp_ns)) / 2) if len(stamp_ns) > 1 else 50_000_000
    waiting = list(wanted)
    offset: int | None = None
    before: tuple[int, np.ndarray] | None = None

    def nearest(candidates: list[tuple[int, np.ndarray] | None]) -> Iterator[tuple[int, np.ndarray]]:
        index = waiting.pop(0)
        target = int(stamp_ns[index])
        near = [c for c in candidates if c is not None and abs(c[0] - target) <= half]
        if near:
            yield index, min(near, key=lambda c: abs(c[0] - target))[1]

    for frame in images.frames:
        if offset is None:
            offset = _clock_offset_ns(motion, frame.stamp_ns, images.duration_s, half)
        now = (frame.stamp_ns + offset, frame.image)
        while waiting and now[0] >= int(stamp_ns[waiting[0]]):
            yield from nearest([before, now])
        if not waiting:
            return
        before = now
    if waiting:
        yield from nearest([before])


def _clock_offset_ns(motion: Shown, first_ns: int, duration_s: float | None, half_ns: int) -> int:
    """Time from the images' clock to the motion's, ns: 0 where the motion lies within the images' time.

    A motion begins after its first image where the first poses were left out: without a subject or telemetry.
    With a foreign clock it begins with the first image of the clip that it states.

    first_ns, duration_s : stamp of the first image, time to the last one if known
    half_ns : half the time between two poses
    """
    begin_ns, end_ns = int(motion.stamp_ns[0]), int(motion.stamp_ns[-1])
    length_ns = end_ns - begin_ns if duration_s is None else round(1e9 * duration_s)
    if first_ns - half_ns <= begin_ns and end_ns <= first_ns + length_ns + _slack_ns(end_ns - begin_ns):
        return 0
    start_s = _stated(motion, "clip").get("start_s")
    return begin_ns - first_ns - (round(1e9 * start_s) if isinstance(start_s, int | float) else 0)


def _slack_ns(length_ns: int) -> int:
    """Greatest excess of a motion's length over the stated one of its images: rates in containers are rounded."""
    return max(500_000_000, round(_OTHERWISE * length_ns))


class _Encoder:
    """Crops, shrinks and compresses each image into its share of the bytes."""

    def __init__(self) -> None:
        self._most = int(MAX_BYTES * 0.75 / MAX_IMAGES)
        self._step = 0  # of the last image: the next one takes hardly more or fewer bytes
        self._growth = [_GROWTH] * len(_STEPS)  # of the bytes from each step to the better one, in the last try

    def __call__(self, image: np.ndarray, box: Box) -> bytes:
        """JPEG of a part of an image (H, W, 3) uint8 BGR: of the best step that fits."""
        x0, y0, x1, y1 = box
        part = image[y0:y1, x0:x1]
        data = _compressed(part, self._step)
        while len(data) * self._growth[self._step] <= self._most and self._step:
            better = _compressed(part, self._step - 1)
            self._growth[self._step] = len(better) / len(data)
            if len(better) > self._most:
                break
            data, self._step = better, self._step - 1
        while len(data) > self._most and self._step < len(_STEPS) - 1:
            self._step += 1
            data = _compressed(part, self._step)
        return data


def _compressed(image: np.ndarray, step: int) -> bytes:
    import cv2

    share, quality = _STEPS[step]
    # The longer side has 480 px in the page: the subject takes most of it.
    scale = min(1.0, 480 / max(image.shape)) / share
    small = shrink(image, (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))))
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
