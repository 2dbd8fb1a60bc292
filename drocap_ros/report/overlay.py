"""Videos for people, H.264 in MP4: the overlay of the subject, and the picture of all persons with their numbers."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from drocap_ros.errors import DrocapError, InputError, first_line
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.people import FoundPerson
from drocap_ros.perception.sources.base import Frame
from drocap_ros.perception.sources.video import pyav
from drocap_ros.skeleton import side_of

#: Rates that players show, images/s, and the greatest denominator of one.
_RATES_HZ, _DENOMINATOR = (1.0, 120.0), 1_000_000


class VideoFile:
    """One MP4 file of images (H, W, 3) uint8 BGR, a context manager; an error inside it ends the file.

    Raises DrocapError when the file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate_hz: float) -> None:
        """Open a file of images of an even width and height, px, at a rate in images/s, brought to 1 to 120."""
        self._path, self._av = path, pyav()
        rate = Fraction(min(max(rate_hz, _RATES_HZ[0]), _RATES_HZ[1])).limit_denominator(_DENOMINATOR)
        # Four pixels share a colour, and the index comes first: what browsers and phones expect.
        try:
            self._file = self._av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
            # Quality of H.264 (constant rate factor): thin lines stay clean, ten seconds of 720p take a few megabytes.
            self._stream = self._file.add_stream("libx264", rate, options={"preset": "veryfast", "crf": "20"})
        except self._av.codec.codec.UnknownCodecError:
            raise InputError("H.264: expected PyAV with libx264, found none; install av from PyPI") from None
        except self._av.error.FFmpegError as error:
            raise self._failed(error) from None
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"

    def write(self, image: np.ndarray) -> None:
        """Append an image of the file's size."""
        self._encode(self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24"))

    def _encode(self, frame: Any) -> None:
        try:
            self._file.mux(self._stream.encode(frame))
            if frame is None:
                self._file.close()
        except self._av.error.FFmpegError as error:
            raise self._failed(error) from None

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is None:
            self._encode(None)

    def _failed(self, error: Exception) -> DrocapError:
        reason = first_line(error)
        return DrocapError(f"{self._path.name}: the video could not be written ({reason}); check the space on the disk")


#: BGR; the sides as in the markers and the viewer.
_COLOURS = {"left": (255, 160, 40), "right": (60, 60, 255), "middle": (90, 220, 90)}
#: Points of the scene and their ways over the last second: magenta, as few scenes have it.
_POINT, _TRAIL, _TRAIL_NS = (255, 0, 255), (210, 90, 210), 1_000_000_000


def draw(image: np.ndarray, observation: PoseObservation) -> np.ndarray:
    """Copy of the image (H, W, 3) uint8 BGR with box, bones and 2-sigma ellipses; right red, left blue.

    A predicted box has a thin line.
    """
    import cv2

    out = image.copy()
    line_px = max(1, round(max(image.shape[:2]) / 640))
    if not observation.has_subject:
        _label(out, "no subject", (8, 24 * line_px), line_px)
        return out
    x0, y0, x1, y1 = (round(float(v)) for v in observation.roi)
    cv2.rectangle(out, (x0, y0), (x1, y1), (0, 220, 255), line_px if observation.detection_score == 0 else 2 * line_px)
    _label(
        out,
        f"{observation.track_id}  {observation.detection_score:.2f}",
        (x0, max(y0 - 4 * line_px, 12 * line_px)),
        line_px,
    )
    points, seen = observation.keypoints, np.isfinite(observation.keypoints).all(axis=1)
    joints = observation.joints
    colours = [_COLOURS[side_of(name, joints.joints)] for name in joints.joints]
    for parent, child in joints.bones:
        if seen[parent] and seen[child]:
            start, end = (np.round(points[j]).astype(int).tolist() for j in (parent, child))
            cv2.line(out, start, end, colours[child], 2 * line_px, cv2.LINE_AA)
    for joint in np.nonzero(seen)[0]:
        _ellipse(out, points[joint], observation.covariance[joint], colours[joint], line_px)
    return out


class Trails:
    """Fixed points of the scene with their way over the last second."""

    def __init__(self) -> None:
        self._past: deque[tuple[int, dict[int, np.ndarray]]] = deque()

    def draw(self, image: np.ndarray, observation: PoseObservation) -> np.ndarray:
        """Copy of the next image (H, W, 3) uint8 BGR with the points; those that began in it are small."""
        import cv2

        out, points = image.copy(), observation.background
        now = {} if points is None else dict(zip(points.track.tolist(), points.point, strict=True))
        self._past.append((observation.stamp_ns, now))
        while observation.stamp_ns - self._past[0][0] > _TRAIL_NS:
            self._past.popleft()
        line_px = max(1, round(max(image.shape[:2]) / 640))
        for track, point in now.items():
            way = np.round([past[track] for _, past in self._past if track in past]).astype(int)
            cv2.polylines(out, [way[:, None]], False, _TRAIL, line_px, cv2.LINE_AA)
            radius = 2 * line_px if len(way) > 1 else line_px
            cv2.circle(out, tuple(np.round(point).astype(int).tolist()), radius, _POINT, -1, cv2.LINE_AA)
        return out


class OverlayVideo:
    """The video with the subject drawn, at a rate in images/s; without one, at that of its first two frames.

    A context manager, which closes the file.
    """

    def __init__(self, path: Path, rate_hz: float | None, *, with_points: bool = False) -> None:
        self._path, self._rate_hz = path, rate_hz
        self._trails = Trails() if with_points else None
        self._first: tuple[int, np.ndarray] | None = None
        self._video: VideoFile | None = None

    def add(self, frame: Frame, observations: Sequence[PoseObservation]) -> None:
        """Draw everybody in a frame and append it."""
        import cv2

        height, width = frame.image.shape[:2]
        # Longer side of the overlay's video, px.
        scale = min(1.0, 1280 / max(width, height))
        size = (max(2, round(width * scale) // 2 * 2), max(2, round(height * scale) // 2 * 2))
        drawn = frame.image
        if self._trails is not None and observations:
            drawn = self._trails.draw(drawn, observations[0])
        for observation in observations:
            drawn = draw(drawn, observation)
        image = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
        if self._first is None:
            self._first = frame.stamp_ns, image
        elif self._video is None:
            self._open(self._rate_hz or 1e9 / (frame.stamp_ns - self._first[0])).write(image)
        else:
            self._video.write(image)

    def _open(self, rate_hz: float) -> VideoFile:
        assert self._first is not None
        image = self._first[1]
        self._video = VideoFile(self._path, (image.shape[1], image.shape[0]), rate_hz)
        self._video.write(image)
        return self._video

    def __enter__(self) -> OverlayVideo:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None and self._video is None and self._first is not None:
            self._open(1.0)  # a single image
        if self._video is not None:
            self._video.__exit__(kind, error, at)


def draw_numbers(image: np.ndarray, boxes: dict[int, np.ndarray], title: str) -> np.ndarray:
    """Copy of the image (H, W, 3) uint8 BGR with a number at each box (4,) px and a title at the top."""
    import cv2

    out = image.copy()
    line_px = max(1, round(max(image.shape[:2]) / 640))
    for number, box in boxes.items():
        x0, y0, x1, y1 = (round(float(v)) for v in box)
        cv2.rectangle(out, (x0, y0), (x1, y1), (0, 220, 255), 2 * line_px)
        _label(out, str(number), (x0 + 2 * line_px, max(y0 - 6 * line_px, 30 * line_px)), 2 * line_px)
    _label(out, title, (8, 20 * line_px), line_px)
    return out


def _ellipse(
    image: np.ndarray, centre: np.ndarray, covariance: np.ndarray, colour: tuple[int, int, int], line_px: int
) -> None:
    import cv2

    xx, xy, yy = (float(v) for v in covariance)
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    # Radius of the ellipses in standard deviations.
    radii = 2.0 * np.sqrt(np.maximum(values, 0.25))
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    at = tuple(int(v) for v in np.round(centre))
    cv2.ellipse(
        image, at, (round(float(radii[1])), round(float(radii[0]))), angle, 0, 360, colour, line_px, cv2.LINE_AA
    )


def _label(image: np.ndarray, text: str, place: tuple[int, int], line_px: int) -> None:
    import cv2

    for colour, width in (((0, 0, 0), 3 * line_px), ((255, 255, 255), line_px)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5 * line_px, colour, width, cv2.LINE_AA)


def chosen_stamps(persons: Sequence[FoundPerson]) -> list[int]:
    """Stamps of few images that show all persons, in the order of time: each the one with most of those left."""
    there = {ns: {p.number: p.boxes[ns] for p in persons if ns in p.boxes} for p in persons for ns in p.boxes}

    def worth(ns: int, left: set[int]) -> tuple[int, float, int]:
        # The larger the smallest of the new persons, the better the picture.
        new = [float(np.prod(box[2:] - box[:2])) for number, box in there[ns].items() if number in left]
        return len(new), min(new, default=0.0), -ns

    left = {person.number for person in persons}
    stamps: list[int] = []
    # Most images of the picture of all persons: four columns fill a screen.
    while left and len(stamps) < 12:
        stamps.append(max(there, key=partial(worth, left=left)))
        left = left - there[stamps[-1]].keys()
    return sorted(stamps)


def persons_picture(
    frames: Iterable[Frame], persons: Sequence[FoundPerson]
) -> tuple[np.ndarray, dict[int, np.ndarray], int]:
    """Pictures (H, W, 3) uint8 BGR of all and of each, and the first frame's stamp, ns.

    The one of all has the images of :func:`chosen_stamps` with numbered boxes.
    """
    import cv2

    wanted, tiles, begin_ns = chosen_stamps(persons), [], 0
    each: dict[int, np.ndarray] = {}
    for number, frame in enumerate(frames):
        begin_ns = begin_ns if number else frame.stamp_ns
        if frame.stamp_ns not in wanted:
            continue
        # Largest width of each, px.
        shrink = min(1.0, 960 / frame.image.shape[1])
        small = cv2.resize(frame.image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        boxes = {p.number: p.boxes[frame.stamp_ns] * shrink for p in persons if frame.stamp_ns in p.boxes}
        for number, (x0, y0, x1, y1) in boxes.items():
            each.setdefault(number, small[max(int(y0), 0) : int(y1) + 1, max(int(x0), 0) : int(x1) + 1].copy())
        tiles.append(draw_numbers(small, boxes, f"{(frame.stamp_ns - begin_ns) * 1e-9:.1f} s"))
        if frame.stamp_ns == wanted[-1]:
            break
    columns = int(np.ceil(np.sqrt(len(tiles))))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]), each, begin_ns
