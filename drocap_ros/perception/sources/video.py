"""A video file through FFmpeg, with the container's own times."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent

log = logging.getLogger(__name__)

#: Frames that a container may promise beyond those that decode before it counts as cut off.
_TAIL_FRAMES = 2


def quiet_ffmpeg() -> None:
    """Keep FFmpeg's and OpenCV's own lines out of the terminal: every failure is reported once, by us."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


#: OpenCV hands options to FFmpeg through one variable of the whole process.
_OPTIONS_LOCK = threading.Lock()
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"


@contextlib.contextmanager
def ffmpeg_options(options: str | None) -> Iterator[None]:
    """Options for the captures opened inside; a user's own in the environment come first."""
    with _OPTIONS_LOCK:
        if options is None or _OPTIONS in os.environ:
            yield
            return
        os.environ[_OPTIONS] = options
        try:
            yield
        finally:
            del os.environ[_OPTIONS]


class VideoSource(ImageSource):
    """Frames of a video file.

    A stamp is the frame's presentation time in its container, from 0 at the first, plus ``start_ns``:
    variable frame rates keep their times and the nominal rate is used for nothing.  Rotation metadata is
    applied.  A file that is cut off gives its frames up to the cut and an ``ended_early`` event; one
    without a readable index or first frame is an error.

    Raises
    ------
    InputError
        When the file is missing, empty, or no video of which a frame can be decoded.
    """

    def __init__(self, path: Path, start_ns: int = 0) -> None:
        super().__init__()
        import cv2

        quiet_ffmpeg()
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: expected a video file, found no such file; check the path")
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path}: expected a video file, found 0 bytes; copy or record it again")
        with ffmpeg_options(None):  # not while a stream is being opened with other options
            self._capture: Any = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise InputError(
                f"{path}: expected a video that FFmpeg can open, found {size} bytes without a readable header or index"
                " (no video, or cut off); copy or record it again"
            )
        self._start_ns = start_ns
        self._origin_ns: int | None = None
        self._last_ns: int | None = None
        self._count = 0
        promised = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        # A container without an index promises nonsense (negative or huge); then nothing is promised.
        self.length = int(promised) if 0 < promised < 1e9 else None
        self._pending = self._decode()
        if self._pending is None:
            self.close()
            raise InputError(f"{path}: expected a video, found no frame that decodes; copy or record it again")
        height, width = self._pending.image.shape[:2]
        self.size = (width, height)

    def read(self) -> Frame | None:
        """Next frame, or None at the end."""
        frame, self._pending = self._pending or self._decode(), None
        if frame is None:
            self._report_end()
            return None
        self._count += 1
        return frame

    def _decode(self) -> Frame | None:
        import cv2

        if self._capture is None:
            return None
        ok, image = self._capture.read()
        if not ok:
            return None
        return Frame(self._stamp(self._capture.get(cv2.CAP_PROP_POS_MSEC)), _three_channels(image))

    def _stamp(self, position_ms: float) -> int:
        now = round(position_ms * 1e6)
        if self._origin_ns is None:
            self._origin_ns = now
        now += self._start_ns - self._origin_ns
        if self._last_ns is not None and now <= self._last_ns:
            # A stream without times (raw H.264): FFmpeg repeats 0.  Its rate is all there is.
            step = round(1e9 / self._nominal_rate())
            if not any(e.kind == "no_times" for e in self._events) and now == self._start_ns:
                self._events.append(
                    SourceEvent("no_times", f"{self.path}: no presentation times; using its nominal rate")
                )
            now = self._last_ns + step
        self._last_ns = now
        return now

    def _nominal_rate(self) -> float:
        import cv2

        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if 0.1 < rate < 1000 else 30.0

    def _report_end(self) -> None:
        if self._capture is not None and self.length is not None and self._count < self.length - _TAIL_FRAMES:
            text = f"{self.path}: cut off or damaged: {self._count} of {self.length} frames decoded"
            log.warning(text)
            self._events.append(SourceEvent("ended_early", text))
        self.close()

    def close(self) -> None:
        """Close the file."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _three_channels(image: np.ndarray) -> np.ndarray:
    from drocap_ros.perception.sources.pictures import to_bgr

    if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
        return image
    return to_bgr(image)
