"""Parameters of image ingest."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class ImageIngestConfig(Parameters):
    """Image source, and how its images are published."""

    source: str = param("", "video file, image folder, /dev/videoN, rtsp://, udp://, or topic:NAME of an image topic")
    loop: bool = param(False, "restart a file at its end; stamps continue to increase")
    realtime: bool = param(True, "publish a file at the pace of its stamps; false: as fast as it decodes")
    max_rate_hz: float = param(0.0, "images beyond this rate are skipped; 0 = none", unit="Hz", minimum=0, maximum=1000)
    folder_rate_hz: float = param(
        30.0, "rate of an image folder whose file names are not stamps", unit="Hz", minimum=0.01, maximum=1000
    )
    jpeg_quality: int = param(90, "quality of the published JPEG", minimum=1, maximum=100)
    width_px: int = param(0, "requested from a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    height_px: int = param(0, "requested from a V4L2 camera; 0 = its default", unit="px", minimum=0, maximum=16384)
    rate_hz: float = param(0.0, "requested from a V4L2 camera; 0 = its default", unit="Hz", minimum=0, maximum=1000)
    stall_timeout_s: float = param(
        1.5, "a live source without an image for this long is reported as stalled", unit="s", minimum=0.1, maximum=60
    )
    reconnect_max_s: float = param(
        10.0, "longest pause between attempts to reconnect to a live source", unit="s", minimum=0.1, maximum=600
    )
    calibration_file: str = param(
        "", "camera calibration YAML (camera_calibration format), whose distortion is not removed; empty: none"
    )
    horizontal_fov_deg: float = param(
        0.0, "horizontal field of view where there is no calibration; 0 = unknown", unit="deg", minimum=0, maximum=170
    )
    frame_id: str = param("camera_optical", "optical frame of the images")
