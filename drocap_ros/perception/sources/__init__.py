"""Image sources: video files, folders of pictures, cameras and network streams, behind one iterator."""

from drocap_ros.perception.sources.base import Frame, ImageSource, SourceEvent
from drocap_ros.perception.sources.open import open_source

__all__ = ["Frame", "ImageSource", "SourceEvent", "open_source"]
