"""Node ``image_ingest``: a video file, picture folder, camera or stream in, JPEG pictures out.

Publishes ``image/compressed`` (sensor_msgs/CompressedImage) and, where the camera is known, ``camera_info``.
Stamps are the exposure times: those of the source, counted from the node's start for a file.
"""

from __future__ import annotations

import threading
import time
from array import array
from typing import Any

from sensor_msgs.msg import CameraInfo, CompressedImage

from drocap_ros.errors import DrocapError
from drocap_ros.nodes.component import ERROR, OK, ComponentNode
from drocap_ros.nodes.conversions import header_at
from drocap_ros.nodes.run import node_main
from drocap_ros.perception.calibration import CameraModel, camera_model
from drocap_ros.perception.images import encode_jpeg
from drocap_ros.perception.sources import Frame, ImageSource, open_source


class ImageIngestNode(ComponentNode):
    """Reads its source in a thread of its own, so that a slow source never blocks the node."""

    component = "image_ingest"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._source: ImageSource = open_source(self.config.source, self.config)
        self._camera: CameraModel | None = camera_model(self.config, self._source.size)
        self._images = self.output("image/compressed")
        self._infos = self.output("camera_info")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="image_ingest", daemon=True)

    def on_start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading and release the source."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._source.close()

    def _run(self) -> None:
        # Files are stamped from the moment of the start, so that their pictures fit the vehicle's telemetry.
        origin_ns = 0 if self._source.live else self.get_clock().now().nanoseconds
        begin = time.monotonic()
        try:
            for frame in self._source:
                if self._stop.is_set():
                    return
                if not self._source.live and self.config.realtime:
                    self._stop.wait(max(0.0, begin + frame.stamp_ns * 1e-9 - time.monotonic()))
                self._publish(frame, origin_ns + frame.stamp_ns)
            self.report(OK, "the source has ended")
        except DrocapError as error:
            self.report(ERROR, str(error))
        if not self._stop.is_set():
            self.finish()

    def _publish(self, frame: Frame, stamp_ns: int) -> None:
        header = header_at(stamp_ns, self.config.frame_id)
        jpeg = encode_jpeg(frame.image, self.config.jpeg_quality)
        self._images.publish(CompressedImage(header=header, format="bgr8; jpeg compressed bgr8", data=array("B", jpeg)))
        if self._camera is not None:
            self._infos.publish(_camera_info(header, self._camera))
        self.count("images")


def _camera_info(header: Any, camera: CameraModel) -> CameraInfo:
    k = camera.matrix.ravel().tolist()
    return CameraInfo(
        header=header,
        width=camera.width,
        height=camera.height,
        distortion_model=camera.distortion_model,
        d=camera.distortion.tolist(),
        k=k,
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[k[0], 0.0, k[2], 0.0, 0.0, k[4], k[5], 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def main() -> int:
    """Run the node as a process."""
    return node_main(ImageIngestNode)


if __name__ == "__main__":
    raise SystemExit(main())
