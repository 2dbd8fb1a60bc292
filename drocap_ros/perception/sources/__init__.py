"""Image sources: video files, image folders, cameras and network streams, behind one iterator."""

from __future__ import annotations

import re
from pathlib import Path

from drocap_ros.errors import InputError
from drocap_ros.file_kind import FileKind, file_kind
from drocap_ros.perception.sources.base import (
    Frame,
    ImageIngestConfig,
    ImageSource,
    SourceEvent,
    SourceEventKind,
    prefetch,
)
from drocap_ros.perception.sources.image_files import ImageFileSource, is_mjpeg
from drocap_ros.perception.sources.live_source import open_camera, open_stream
from drocap_ros.perception.sources.video import VideoSource

__all__ = ["Frame", "ImageSource", "SourceEvent", "SourceEventKind", "open_source", "prefetch"]

_STREAM = re.compile(r"^(rtsps?|udp|rtp|rtmp|srt|tcp|https?)://", re.IGNORECASE)
_CAMERA = re.compile(r"^/dev/video(\d+)$")


def open_source(uri: str | Path, config: ImageIngestConfig | None = None, track: str = "") -> ImageSource:
    """Source for a video file, an image, a folder of images, ``/dev/videoN``, or a stream's URL.

    uri : path or URL; ``file://`` is allowed
    config : rates, camera mode and time-outs; ``config.source`` is ignored
    track : number of a video's track; empty: the largest
    """
    config, text = config or ImageIngestConfig(), str(uri)
    if camera := _CAMERA.match(text):
        return open_camera(int(camera[1]), config)
    return open_stream(text, config) if _STREAM.match(text) else _open_path(text, config, track)


def _open_path(text: str, config: ImageIngestConfig, track: str) -> ImageSource:
    path = Path(text.removeprefix("file://"))
    if not text or not path.exists():
        raise InputError(
            f"{text or 'source'}: expected a video file, image folder, /dev/videoN, rtsp:// or udp://; found no such"
            " file; check the path"
        )
    if path.is_fifo() or path.suffix.lower() == ".sdp":
        return open_stream(str(path), config)
    if path.is_dir() or (file_kind(path) is FileKind.IMAGE and not is_mjpeg(path)):
        return ImageFileSource(path, config.folder_rate_hz)
    return VideoSource(path, track)
