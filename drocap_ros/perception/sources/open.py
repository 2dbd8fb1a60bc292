"""One door for every kind of source."""

from __future__ import annotations

import re
from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.perception.perception_config import ImageIngestConfig
from drocap_ros.perception.sources.base import ImageSource
from drocap_ros.perception.sources.pictures import SUFFIXES, PictureSource
from drocap_ros.perception.sources.video import VideoSource

_STREAM = re.compile(r"^(rtsps?|udp|rtp|rtmp|srt|tcp|https?)://", re.IGNORECASE)
_CAMERA = re.compile(r"^(/dev/video|v4l2:)(\d+)$")


def open_source(uri: str | Path, config: ImageIngestConfig | None = None, start_ns: int = 0) -> ImageSource:
    """Source for a video file, a picture, a folder of pictures, ``/dev/videoN``, or a stream's URL.

    Parameters
    ----------
    uri : path or URL; ``file://`` is allowed
    config : rates, camera mode and time-outs; ``config.source`` is not read
    start_ns : stamp of a file's first frame; a live source has the clock's time

    Raises
    ------
    InputError
        When the source cannot be opened.
    """
    config = config or ImageIngestConfig()
    text = str(uri)
    if camera := _CAMERA.match(text):
        from drocap_ros.perception.sources.live import open_camera

        return open_camera(int(camera[2]), config)
    if _STREAM.match(text):
        from drocap_ros.perception.sources.live import open_stream

        return open_stream(text, config)
    path = Path(text.removeprefix("file://"))
    if not text or not path.exists():
        raise InputError(
            f"{text or 'source'}: expected a video file, picture folder, /dev/videoN, rtsp:// or udp://; found no such"
            " file; check the path"
        )
    if path.is_fifo() or path.suffix.lower() == ".sdp":
        from drocap_ros.perception.sources.live import open_stream

        return open_stream(str(path), config)
    if path.is_dir() or path.suffix.lower() in SUFFIXES:
        return PictureSource(path, config.folder_rate_hz)
    return VideoSource(path, start_ns)
