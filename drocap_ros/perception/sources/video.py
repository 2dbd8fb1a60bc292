"""Video file, decoded by FFmpeg, with the container's presentation times."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.movie_index import formats, largest_alone, movie_s
from drocap_ros.perception.sources.pixels import to_bgr

if TYPE_CHECKING:
    import cv2

log = logging.getLogger(__name__)

#: Missing frames at the end, against the container's count, from which the file counts as cut off.
_TAIL_FRAMES = 2
#: First bytes of Matroska and WebM, which state a duration and no count.
_MATROSKA = b"\x1a\x45\xdf\xa3"
#: Codecs in words by their codes; others are named by their codes.
_CODECS = {"AV01": "AV1", "AVC1": "H.264", "H264": "H.264", "HEVC": "H.265", "HVC1": "H.265", "HEV1": "H.265"}
#: Least and most first pictures that are compared, since OpenCV 4.13 leaves interlaced ones unwritten.
_PROBED = (5, 24)
#: A larger packet changes its picture: that of a still one has some bytes, and a bit or two for each block of 256 px.
_STILL_BYTES, _STILL_PIXELS = 200, 1024
#: Pixels of other shapes are not believed.
_MAX_ASPECT = 4.0
_CONVERT = "ffmpeg -i IN -vf yadif -c:v libx264 -pix_fmt yuv420p OUT.mp4"


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
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        quiet_ffmpeg()
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: expected a video file, found no such file; check the path")
        if (kind := file_kind(path)) is not FileKind.VIDEO:
            raise InputError(f"{path}: expected a video file, found {kind.value}; check the path, or record it again")
        self._pending = deque[Frame]()
        self._begin(self._opened())
        if not self._pending or self._unwritten():
            self._refuse()
        height, width = self._pending[0].image.shape[:2]
        self.size = (width, height)

    def _opened(self) -> cv2.VideoCapture:
        import cv2

        # The options are held: not while another thread opens with its own.
        with ffmpeg_options(None), largest_alone(self.path) as name:
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise InputError(
                f"{self.path}: expected a video that FFmpeg can open, found {self.path.stat().st_size} bytes without a"
                f" readable header or index (cut off, or of an unknown codec{formats(self.path)}); copy it again"
            )
        return capture

    def _begin(self, capture: cv2.VideoCapture) -> None:
        """Read the first picture, and what the container states."""
        import cv2

        self._capture = capture
        self._origin_ns: int | None = None
        self._last_ns: int | None = None
        self._count = 0
        with self.path.open("rb") as file:
            self._counted = file.read(4) != _MATROSKA
        stated, rate = capture.get(cv2.CAP_PROP_FRAME_COUNT), self._nominal_rate()
        # A container without an index states a negative or huge number.
        self.length = int(stated) if 0 < stated < 1e9 else None
        shown_s = movie_s(self.path)
        if self.length and shown_s and shown_s * rate < self.length - _TAIL_FRAMES:
            self.length = max(1, round(shown_s * rate))  # an edit list hides the others, as after a trim
        self.duration_s = (self.length - 1) / rate if self.length else None
        self._pending = deque(frame for frame in (self._decode(),) if frame)

    def _unwritten(self) -> bool:
        """Whether the first pictures are equal although their packets differ and change them."""
        import cv2

        first = self._pending[0].image
        while len(self._pending) < _PROBED[1] and (frame := self._decode()):
            if not np.array_equal(frame.image, first):
                self._pending.append(frame)
                return False
            self._pending.append(Frame(frame.stamp_ns, first))  # many of them are one in memory
        raw = cv2.VideoCapture(str(self.path.absolute()), cv2.CAP_FFMPEG)
        raw.set(cv2.CAP_PROP_FORMAT, -1)  # packets as they are
        packets = [packet.tobytes() for ok, packet in (raw.read() for _ in self._pending) if ok]
        raw.release()
        largest_still = _STILL_BYTES + first.shape[0] * first.shape[1] // _STILL_PIXELS
        differ = len(set(packets)) >= _PROBED[0]  # some programs repeat packets to raise the rate
        return differ and float(np.median([len(packet) for packet in packets])) > largest_still

    def _refuse(self) -> None:
        import cv2

        code = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode("latin1").upper()
        words = f"{_CODECS.get(code, code)} without a frame that it decodes"
        words = "interlaced pictures that it leaves empty" if self._pending else words
        self.close()
        opencv = f"OpenCV {cv2.__version__}"
        raise InputError(f"{self.path}: expected a video for {opencv}, found {words}; convert it: {_CONVERT}")

    def read(self) -> Frame | None:
        """Next frame, or None at the end."""
        frame = self._pending.popleft() if self._pending else self._decode()
        if frame is None:
            self._report_end()
            return None
        self._count += 1
        return frame

    def _decode(self) -> Frame | None:
        import cv2

        ok, image = self._capture.read()
        if not ok:
            return None
        return Frame(self._stamp(self._capture.get(cv2.CAP_PROP_POS_MSEC)), self._square(to_bgr(image)))

    def _square(self, image: np.ndarray) -> np.ndarray:
        """The picture as it is shown, where its pixels are no squares."""
        import cv2

        ratio = self._capture.get(cv2.CAP_PROP_SAR_NUM) / (self._capture.get(cv2.CAP_PROP_SAR_DEN) or 1.0)
        if ratio == 1.0 or not 1 / _MAX_ASPECT <= ratio <= _MAX_ASPECT:
            return image
        turned = int(self._capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 180 == 90
        across = 1 / ratio if turned else ratio
        height, width = image.shape[:2]
        size = (round(width * across), height) if across > 1 else (width, round(height / across))
        return cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)

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
        if self._capture.isOpened() and (detail := self._missing_end()):
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
        self._capture.release()
