"""Images of a video, image folder, stream or recording, one at a time."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.perception.sources import Frame, open_source
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.recording.image_messages import choose_images, read_images
from drocap_ros.recording.keypoints.files import is_keypoint_file
from drocap_ros.recording.open_session import is_recording, open_session
from drocap_ros.recording.telemetry.read import LOG_SUFFIXES

logger = logging.getLogger(__name__)

#: Every such pixel of a row and of a column counts for it.
_SAMPLING = 8


class Images(NamedTuple):
    """Images in the order of time.

    length : their number, where stated
    duration_s : from the first to the last, where known
    """

    frames: Iterable[Frame]
    length: int | None
    duration_s: float | None

    @property
    def rate_hz(self) -> float | None:
        """Mean rate, where length and duration are known."""
        return (self.length - 1) / self.duration_s if self.length and self.duration_s else None


@contextlib.contextmanager
def open_images(source: str | Path, config: ImageIngestConfig | None = None, topic: str = "") -> Iterator[Images]:
    """Open a video file, image, folder of images, stream or recording; warnings of a recording are logged at the end.

    topic : of a recording; empty: that of :func:`drocap_ros.recording.image_messages.choose_images`; of a video the
        number of its track; empty: the largest
    """
    path = Path(source)
    if path.exists():
        refuse_other_inputs(path)
    if path.exists() and is_recording(path):
        with open_session(path) as session:
            choose_images(session, topic)  # read_images refuses only when it begins
            yield Images(_visible(path, read_images(session, topic)), None, session.info.duration_s)
            for warning in session.warnings:
                logger.warning("%s: %s", path, warning)
        return
    if topic and not (path.is_file() and file_kind(path) is FileKind.VIDEO):
        raise InputError(f"--topic {topic}: expected a recording with topics, found {source}; leave the option out")
    with open_source(source, config, topic) as images:
        yield Images(_visible(source, images), images.length, images.duration_s)


def _visible(source: str | Path, frames: Iterable[Frame]) -> Iterator[Frame]:
    """The frames; refused at their end when none of them shows anything."""
    count, blank = 0, True
    for frame in frames:
        count += 1
        blank = blank and is_blank(frame.image)
        yield frame
    if count > 1 and blank:
        raise InputError(
            f"{source}: expected pictures, found {count} of one colour; look at them, or convert them:"
            " ffmpeg -i IN -pix_fmt yuv420p OUT.mp4"
        )


def is_blank(image: np.ndarray) -> bool:
    """Whether an image (H, W, 3) uint8 shows nothing."""
    # Standard deviation of the values, of 255, below which a picture shows nothing: noise of a covered lens.
    return float(image[::_SAMPLING, ::_SAMPLING].std()) < 1.0


def refuse_other_inputs(path: Path) -> None:
    """Refuse the folder of a motion and a telemetry log in the place of images."""
    if path.is_dir() and (path / "motion.npz").is_file() and not is_recording(path):
        again = next((path / name for name in ("session", "tracks.npz") if (path / name).exists()), None)
        hint = f"; `drocap reconstruct {again}` repeats it" if again else ""
        raise InputError(
            f"{path}: expected a video, image folder, recording or tracks file, found the folder of a motion;"
            f" `drocap report {path}` shows it{hint}"
        )
    if path.suffix != ".npz" and is_keypoint_file(path):
        raise InputError(
            f"{path}: expected a video, image folder, recording or tracks file, found 2D keypoints; `drocap reconstruct"
            f" {path}` takes them"
        )
    if path.suffix.lower() in LOG_SUFFIXES:
        raise InputError(
            f"{path}: expected a video, image folder, recording or tracks file, found a telemetry log; name its video"
            f" and add --telemetry {path}"
        )
