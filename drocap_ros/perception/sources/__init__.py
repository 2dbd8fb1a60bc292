"""Image sources: video files, image folders, cameras and network streams, behind one iterator."""

from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent, SourceEventKind
from drocap_ros.perception.sources.open import open_source

__all__ = ["Frame", "ImageSource", "SourceEvent", "SourceEventKind", "open_source"]
