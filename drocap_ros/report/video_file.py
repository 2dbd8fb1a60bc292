"""Video files for people: H.264, which browsers and phones play, by the program FFmpeg; else MPEG-4 by OpenCV."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import sys
from pathlib import Path
from types import TracebackType

import numpy as np

from drocap_ros.errors import DrocapError, InputError, first_line

#: Quality of H.264 (constant rate factor): thin lines stay clean, ten seconds of 720p take a few megabytes.
_CRF = 20
#: Rates that players show, images/s.
_RATES_HZ = (1.0, 120.0)


def find_ffmpeg() -> str | None:
    """The program FFmpeg: that of the package imageio-ffmpeg, else the system's; None = there is neither."""
    with contextlib.suppress(ImportError, RuntimeError):  # RuntimeError: a platform for which it holds no program
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    return shutil.which("ffmpeg")


def install_words() -> str:
    """What to run where no FFmpeg is."""
    return f"{sys.executable} -m pip install imageio-ffmpeg"


class VideoFile:
    """One MP4 file of images (H, W, 3) uint8 BGR, a context manager; an error inside it ends the encoder.

    Raises
    ------
    InputError
        When H.264 is required, and no FFmpeg is found.
    DrocapError
        When the file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate_hz: float, *, require_h264: bool = False) -> None:
        """Open a file of images of an even width and height, px, at a rate in images/s, brought to 1 to 120."""
        self._path, self._size, self._count = path, size, 0
        self._rate_hz = min(max(rate_hz, _RATES_HZ[0]), _RATES_HZ[1])
        program = find_ffmpeg()
        if program is None and require_h264:
            raise InputError(f"H.264: expected the program FFmpeg, found none; run {install_words()}")
        self.codec = "H.264" if program else "MPEG-4"
        self._process = self._start(program) if program else None
        if self._process is None:
            import cv2

            self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), self._rate_hz, size)
            if not self._writer.isOpened():
                raise self._failed()

    def _start(self, program: str) -> subprocess.Popen[bytes]:
        width, height = self._size
        source = ["-f", "rawvideo", "-pix_fmt", "bgr24", "-s", f"{width}x{height}", "-r", f"{self._rate_hz:.6f}"]
        # Four pixels share a colour, and the index comes first: what browsers and phones expect.
        target = ["-c:v", "libx264", "-preset", "veryfast", "-crf", str(_CRF), "-pix_fmt", "yuv420p"]
        words = [program, "-loglevel", "error", "-y", *source, "-i", "-", *target, "-movflags", "+faststart"]
        return subprocess.Popen([*words, str(self._path)], stdin=subprocess.PIPE, stderr=subprocess.PIPE)

    def write(self, image: np.ndarray) -> None:
        """Append an image of the file's size."""
        self._count += 1
        if self._process is None:
            self._writer.write(image)
            return
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(np.ascontiguousarray(image).tobytes())
        except BrokenPipeError:
            self._end()
            raise self._failed() from None

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is not None and self._process is not None:
            self._process.kill()
            self._process.wait()
        elif kind is None:
            self._end()

    def _end(self) -> None:
        if self._process is not None:
            said = self._process.communicate()[1].decode(errors="replace").strip()
            if self._process.returncode:
                raise self._failed(said)
            return
        import cv2

        self._writer.release()
        # OpenCV's writer reports no error: a full disk leaves a file without its end.
        video = cv2.VideoCapture(str(self._path))
        found = video.get(cv2.CAP_PROP_FRAME_COUNT) if video.isOpened() else 0
        video.release()
        if found < self._count:
            raise self._failed()

    def _failed(self, said: str = "") -> DrocapError:
        reason = f" ({first_line(ValueError(said))})" if said else ""
        return DrocapError(f"{self._path.name}: the video could not be written{reason}; check the space on the disk")
