"""Node ``image_ingest``: a video file, image folder, camera, stream or image topic in, JPEG images out.

Publishes ``image/compressed`` (sensor_msgs/CompressedImage) and, where the camera is known, ``camera_info``.
Stamps are exposure times: those of the source; of a file, counted from the activation.
With ``source = topic:NAME`` it subscribes to that topic: CompressedImage, or Image in one of the usual encodings, as
its publishers send it; stamps are those of the messages.  Where they offer that, lost fragments of an image are sent
again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.validate_full_topic_name import validate_full_topic_name
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from drocap_ros.errors import DrocapError, InputError
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.perception.calibration import camera_model
from drocap_ros.perception.sources import Frame, ImageSource, open_source
from drocap_ros.perception.sources.base import ImageIngestConfig, prefetch
from drocap_ros.perception.sources.image_files import encode_jpeg
from drocap_ros.recording.image_messages import image_from_message
from drocap_ros.ros.component import ERROR, OK, WARN
from drocap_ros.ros.conversions import camera_info_to_ros, compressed_image_to_ros, header_at, stamp_from_ros
from drocap_ros.ros.diagnostics import Key, of
from drocap_ros.ros.lifecycle import ThreadedSource
from drocap_ros.ros.shared_images import SharedImages
from drocap_ros.ros.topics import TOPIC_SOURCE

#: An image of a file that is this late when it has been read is dropped: three images at 30 Hz.
_LATE_S = 0.1
#: Images of a topic that may arrive together, while the one before is encoded.
_DEPTH = 5
#: Messages of images by the names of their types.
_KINDS = {"sensor_msgs/msg/CompressedImage": CompressedImage, "sensor_msgs/msg/Image": Image}


class ImageIngestNode(ThreadedSource):
    """Reads its source in a thread of its own, so that a slow source never blocks the node."""

    component = "image_ingest"
    config: ImageIngestConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        self._images = self.output("image/compressed")
        self._infos = self.output("camera_info")
        self._shared = SharedImages(self)
        self._camera: CameraModel | None = None
        self._size: tuple[int, int] | None = None
        self._last_ns: int | None = None
        self._arrived_s = time.monotonic()
        self._source: ImageSource | None = None
        self._topic = ""
        self._foreign = ""  # types that are published there, if none is an image
        self._subscription: Subscription | None = None
        self.create_timer(0.5, self._watch)

    def acquire(self) -> None:
        """Open the source, or wait for its topic."""
        if self.config.source.startswith(TOPIC_SOURCE):
            self._topic = self._valid_topic(self.config.source.removeprefix(TOPIC_SOURCE))
            self.report(WARN, f"waiting for images on {self._topic}")
        else:
            self._source = open_source(self.config.source, self.config)
            self._fit_camera(self._source.size)

    def begin(self) -> None:
        """Start or continue to read; a file has advanced meanwhile, as a camera would."""
        self._arrived_s = time.monotonic()
        if self._source is not None:
            super().begin()

    def release(self) -> None:
        """Stop reading and close the source."""
        self.stopping.set()
        # A live source that waits for an image ends by being closed; a file must not be closed while it is read.
        if self._source is not None and self._source.live:
            self._source.close()
        super().release()
        self._shared.close()
        if self._source is not None:
            self._source.close()
            self._source = None
        self._topic = ""
        self._unsubscribe()

    # -- files, cameras, streams -----------------------------------------------------------------------

    def play(self) -> None:
        """Publish the images of the source."""
        try:
            for frame in self._frames():
                if self.stopping.is_set():
                    return
                if not self.active:
                    continue
                try:
                    self._publish(header_at(frame.stamp_ns, self.config.frame_id), frame)
                except InputError as error:
                    self.refuse(str(error))
            self.report(OK, "the source has ended")
        except DrocapError as error:
            self.report(ERROR, str(error))
        if not self.stopping.is_set():
            self.end()

    def _frames(self) -> Iterator[Frame]:
        """Frames with their final stamps, at the configured pace."""
        assert self._source is not None
        if self._source.live:
            yield from self._source
            return
        # Files are stamped from now on, so that their images fit the vehicle's telemetry.
        begin_ns = self.get_clock().now().nanoseconds
        frames = prefetch(self._rounds())
        try:
            for frame in frames:
                stamp_ns = begin_ns + frame.stamp_ns
                if self.config.realtime:
                    ahead_s = (stamp_ns - self.get_clock().now().nanoseconds) * 1e-9
                    if self.stopping.wait(max(0.0, ahead_s)):
                        return
                    if ahead_s < -_LATE_S:
                        # As with a camera: images that the machine is too slow for are dropped, none is late.
                        self.count(Key.IMAGES_LATE)
                        continue
                yield Frame(stamp_ns, frame.image)
        finally:
            frames.close()

    def _rounds(self) -> Iterator[Frame]:
        """Frames of a file, in a loop if configured; stamps from 0, increasing."""
        assert self._source is not None
        offset_ns, last_ns, step_ns = 0, 0, 0
        while True:
            for frame in self._source:
                step_ns = frame.stamp_ns + offset_ns - last_ns or step_ns
                last_ns = frame.stamp_ns + offset_ns
                yield Frame(last_ns, frame.image)
            if not self.config.loop or self.stopping.is_set():
                return
            offset_ns = last_ns + step_ns
            self._source.close()
            self._source = open_source(self.config.source, self.config)

    # -- image topics ----------------------------------------------------------------------------------

    def _valid_topic(self, topic: str) -> str:
        try:
            validate_full_topic_name(expand_topic_name(topic, self.get_name(), self.get_namespace()))
        except (InvalidTopicNameException, ValueError):
            raise InputError(
                f"source: expected {TOPIC_SOURCE}NAME with a name of ROS, as {TOPIC_SOURCE}/camera/image_raw, got"
                f" {topic!r}; correct the name"
            ) from None
        return topic

    def _subscribe(self) -> None:
        """Subscribe to the topic with the type and as reliably as its publishers offer, once there are some."""
        offers: dict[str, set[ReliabilityPolicy]] = {}
        for info in self.get_publishers_info_by_topic(self._topic):
            offers.setdefault(info.topic_type, set()).add(info.qos_profile.reliability)
        name = next((name for name in _KINDS if name in offers), None)
        self._foreign = "" if name else ", ".join(sorted(offers))
        if name is None:
            return
        kind, reliable = _KINDS[name], {ReliabilityPolicy.RELIABLE}
        wanted = ReliabilityPolicy.RELIABLE if offers[name] == reliable else ReliabilityPolicy.BEST_EFFORT
        last = self._subscription
        if last is not None and (last.msg_type, last.qos_profile.reliability) == (kind, wanted):
            return
        self._unsubscribe()
        qos = QoSProfile(depth=_DEPTH, reliability=wanted)
        take = self.newest(self._topic, self._take, stamps=True)
        events = SubscriptionEventCallbacks(message_lost=self._on_lost)
        self._subscription = self.create_subscription(kind, self._topic, take, qos, event_callbacks=events)

    def _on_lost(self, event: QoSMessageLostInfo) -> None:
        self.count(of(Key.LOST, self._topic), event.total_count_change)

    def _unsubscribe(self) -> None:
        if self._subscription is not None:
            self.destroy_subscription(self._subscription)
            self._subscription = None

    def _take(self, message: CompressedImage | Image) -> None:
        stamp_ns = stamp_from_ros(message.header.stamp)
        compressed = isinstance(message, CompressedImage)
        image = image_from_message(message, compressed)
        header = Header(stamp=message.header.stamp, frame_id=message.header.frame_id or self.config.frame_id)
        # A JPEG is passed on unchanged.
        jpeg = bytes(message.data) if compressed and "jp" in message.format.lower() else None
        self._publish(header, Frame(stamp_ns, image), jpeg)

    # -- out -------------------------------------------------------------------------------------------

    def _fit_camera(self, size: tuple[int, int]) -> None:
        """Choose the camera model of images of a size (width, height); an InputError when there is none."""
        if size != self._size:
            self._camera = camera_model(self.config, size)
            self._size = size

    def _publish(self, header: Header, frame: Frame, jpeg: bytes | None = None) -> None:
        self._fit_camera((frame.image.shape[1], frame.image.shape[0]))
        rate = self.config.max_rate_hz
        # A hundredth of slack: a source of exactly that rate keeps every image.
        if rate > 0 and self._last_ns is not None and 0 <= frame.stamp_ns - self._last_ns < 0.99e9 / rate:
            self.count(Key.IMAGES_SKIPPED)
            return
        self._last_ns = frame.stamp_ns
        if self._camera is not None:  # first: the image's keypoints need its lens
            self._infos.publish(camera_info_to_ros(header, self._camera))
        if self._images.get_subscription_count():
            self._shared.put(frame.stamp_ns, frame.image)
            data = jpeg or encode_jpeg(frame.image, self.config.jpeg_quality)
            self._images.publish(compressed_image_to_ros(header, data))
        self.count(Key.IMAGES)
        self.produced(frame.stamp_ns)
        self._arrived_s = time.monotonic()
        self.report(OK, "running")

    def _watch(self) -> None:
        """Look for the topic's publishers; report a camera, stream or topic without images within 2 s."""
        if self._topic:
            self._subscribe()
        for event in self._source.events() if self._source is not None else ():
            self.count(of(Key.SOURCE_EVENT, event.kind.value))
        is_live = self._source is None or self._source.live
        silence_s = time.monotonic() - self._arrived_s
        if self.active and is_live and silence_s > self.config.stall_timeout_s:
            remedy = f"{self._foreign} is published there: name an image topic" if self._foreign else ""
            remedy = remedy or "check the camera and its link"
            self.report(WARN, f"no image from {self.config.source} for {silence_s:.1f} s; {remedy}")
