"""Video files for people: H.264 in MP4, which browsers and phones play."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from drocap_ros.errors import DrocapError, InputError, first_line
from drocap_ros.perception.sources.video import pyav

#: Quality of H.264 (constant rate factor): thin lines stay clean, ten seconds of 720p take a few megabytes.
_CRF = 20
#: Rates that players show, images/s, and the greatest denominator of one.
_RATES_HZ, _DENOMINATOR = (1.0, 120.0), 1_000_000


class VideoFile:
    """One MP4 file of images (H, W, 3) uint8 BGR, a context manager; an error inside it ends the file.

    Raises
    ------
    DrocapError
        When the file cannot be written.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate_hz: float) -> None:
        """Open a file of images of an even width and height, px, at a rate in images/s, brought to 1 to 120."""
        self._path, self._av = path, pyav()
        rate = Fraction(min(max(rate_hz, _RATES_HZ[0]), _RATES_HZ[1])).limit_denominator(_DENOMINATOR)
        # Four pixels share a colour, and the index comes first: what browsers and phones expect.
        try:
            self._file = self._av.open(str(path), "w", format="mp4", options={"movflags": "faststart"})
            self._stream = self._file.add_stream("libx264", rate, options={"preset": "veryfast", "crf": str(_CRF)})
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
