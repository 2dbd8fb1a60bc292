"""Video file, decoded by FFmpeg, with the container's presentation times."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drocap_ros.errors import InputError
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.image_files import to_bgr

log = logging.getLogger(__name__)

#: Missing frames at the end, against the container's count, from which the file counts as cut off.
_TAIL_FRAMES = 2
#: First bytes of Matroska and WebM, which state a duration and no count.
_MATROSKA = b"\x1a\x45\xdf\xa3"


def quiet_ffmpeg() -> None:
    """Silence FFmpeg's and OpenCV's messages; drocap reports each failure once."""
    import cv2

    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    if hasattr(cv2, "setLogLevel"):  # to OpenCV 4.6 (Ubuntu 24.04)
        cv2.setLogLevel(0)
    elif hasattr(cv2.utils, "logging"):
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


#: OpenCV passes options to FFmpeg through one environment variable of the process.
_OPTIONS_LOCK = threading.Lock()
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"


@contextlib.contextmanager
def ffmpeg_options(options: str | None) -> Iterator[None]:
    """Options for captures opened inside the context; options in the user's environment take precedence."""
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

    A stamp is the frame's presentation time in its container, from 0 at the first; variable frame rates keep
    their times.  Rotation metadata is applied.  A file that is cut off gives its frames up to the cut and an
    ``ENDED_EARLY`` event.

    Raises
    ------
    InputError
        When the file is missing or empty, or its index or first frame cannot be decoded.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        import cv2

        quiet_ffmpeg()
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: expected a video file, found no such file; check the path")
        size = path.stat().st_size
        if size == 0:
            raise InputError(f"{path}: expected a video file, found 0 bytes; copy or record it again")
        with ffmpeg_options(None):  # not while another thread opens a stream with its options
            self._capture: Any = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not self._capture.isOpened():
            raise InputError(
                f"{path}: expected a video that FFmpeg can open, found {size} bytes without a readable header or index"
                " (not a video, or cut off); copy or record it again"
            )
        self._origin_ns: int | None = None
        self._last_ns: int | None = None
        self._count = 0
        with path.open("rb") as file:
            self._counted = file.read(4) != _MATROSKA
        stated = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        # A container without an index states a negative or huge number.
        self.length = int(stated) if 0 < stated < 1e9 else None
        self.duration_s = (self.length - 1) / self._nominal_rate() if self.length else None
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
        return Frame(self._stamp(self._capture.get(cv2.CAP_PROP_POS_MSEC)), to_bgr(image))

    def _stamp(self, position_ms: float) -> int:
        now = round(position_ms * 1e6)
        if self._origin_ns is None:
            self._origin_ns = now
        now -= self._origin_ns
        if self._last_ns is not None and now <= self._last_ns:
            # FFmpeg gives 0 for each frame of a stream without times (raw H.264).
            step = round(1e9 / self._nominal_rate())
            kind = SourceEventKind.NO_TIMES
            if not any(e.kind is kind for e in self._events) and now == 0:
                self._events.append(SourceEvent(kind, str(self.path), "the nominal rate is used"))
            now = self._last_ns + step
        self._last_ns = now
        return now

    def _nominal_rate(self) -> float:
        import cv2

        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return rate if 0.1 < rate < 1000 else 30.0

    def _report_end(self) -> None:
        if self._capture is not None and (detail := self._missing_end()):
            event = SourceEvent(SourceEventKind.ENDED_EARLY, str(self.path), f"cut off or damaged, {detail} decoded")
            log.warning(str(event))
            self._events.append(event)
        self.close()

    def _missing_end(self) -> str:
        """What is missing, or nothing."""
        if self.length is None or self.duration_s is None or self._count >= self.length - _TAIL_FRAMES:
            return ""
        if self._counted:
            return f"{self._count} of {self.length} frames"
        # The count is the duration times a rate, which may be far from that of the frames.
        end_s = (self._last_ns or 0) * 1e-9
        if end_s + _TAIL_FRAMES * end_s / max(self._count - 1, 1) >= self.duration_s:
            return ""
        return f"{end_s:.1f} of {self.duration_s:.1f} s"

    def close(self) -> None:
        """Close the file."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None
