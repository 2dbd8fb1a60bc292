"""Node ``pose_estimator``: images in, the subject's keypoints out.

Subscribes ``image/compressed`` (sensor_msgs/CompressedImage) and ``roi`` (sensor_msgs/RegionOfInterest, the box of a
drone's own tracker); publishes ``pose2d`` (drocap_ros/Pose2D) and ``background`` (drocap_ros/BackgroundTracks) with the
image's header.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import NamedTuple

import numpy as np
from sensor_msgs.msg import CompressedImage, RegionOfInterest
from std_msgs.msg import Header

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.load_shedding import Follower
from drocap_ros.perception.sources.base import Frame
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.recording.image_messages import image_from_message
from drocap_ros.ros.component import OK, WARN, ComponentNode, Gaps, Line, MessageInfo
from drocap_ros.ros.conversions import background_to_ros, pose2d_to_ros, stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.own_process import LoadShedding, LookAhead
from drocap_ros.ros.shared_images import SharedImages
from drocap_ros.ros.topics import IMAGE_IN_GRAPH_QOS, publishers_of, subscribers_of

_TOPIC = "image/compressed"
_DEPTH = 4  # images that may wait
_BESIDE_LEVEL = 3  # of load shedding, from which on no image waits for the networks,
_BESIDE_NICENESS = 2  # then: what each image has, and its initial pose, come first
_SLOW_S = 0.04  # as long as they take longer than this for one: every third would leave too little time for the others


class ImageSample(NamedTuple):
    """An image's message that waited to be processed.

    missed : images dropped since the one before
    waited : whether it arrived while the one before was processed
    behind : how many wait behind it
    """

    message: CompressedImage
    missed: int
    waited: bool
    behind: int


class ImageQueue:
    """Images between the thread that receives and the thread that processes: the newest ``depth``.

    Those that have waited too long are passed over (:class:`Line`).  ``clock`` : ns, that of the receptions
    """

    def __init__(self, depth: int, clock: Callable[[], int] = time.time_ns) -> None:
        self._images: deque[tuple[CompressedImage, int]] = deque(maxlen=depth)
        self._clock, self._line = clock, Line(periods=1.0)
        self._missed = self._begin_ns = 0
        self._busy = False
        self._closed = False
        self._changed = threading.Condition()

    def put(self, message: CompressedImage, missed: int = 0) -> None:
        """Append an image; ``missed`` images before it were lost elsewhere."""
        with self._changed:
            self._missed += missed + (len(self._images) == self._images.maxlen)
            self._images.append((message, self._clock()))
            self._changed.notify_all()

    def take(self) -> ImageSample | None:
        """Next image; None at the end.  The image taken before is then done."""
        with self._changed:
            if self._busy:
                self._line.took((self._clock() - self._begin_ns) * 1e-9)
            self._busy = False
            self._changed.notify_all()
            waited = bool(self._images)
            self._changed.wait_for(lambda: self._images or self._closed)
            if self._closed:
                return None
            self._busy, self._begin_ns = True, self._clock()
            message, received_ns = self._images.popleft()
            while self._line.passes_over({"received_timestamp": received_ns}, self._begin_ns) and self._images:
                message, received_ns = self._images.popleft()
                self._missed += 1
            missed, self._missed = self._missed, 0
            return ImageSample(message, missed, waited, len(self._images))

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until no image waits or is processed; returns whether that was reached."""
        with self._changed:
            return self._changed.wait_for(lambda: self._closed or not (self._images or self._busy), timeout_s)

    def close(self) -> None:
        """Return no more images."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class ImageInput:
    """Subscription to ``image/compressed`` that processes in a thread of its own: no image is decoded in vain.

    In simulated time it processes each image on arrival: however long that takes, no image waits or is dropped.

    node : the node that subscribes
    process : called in that thread with a sample; an InputError is counted, any other error ends the node
    depth : images that may wait
    """

    def __init__(
        self,
        node: ComponentNode,
        process: Callable[[ImageSample], None],
        depth: int,
    ) -> None:
        self._node = node
        self._process = node.guarded(_TOPIC, process, stamps=False)  # validated on arrival
        self._gaps = Gaps()
        self._queue = ImageQueue(depth)
        qos = IMAGE_IN_GRAPH_QOS if publishers_of(_TOPIC, node.peers) else None
        node.input(_TOPIC, self._on_message, qos=qos, with_info=True)
        self._thread = node.thread(self._run, "images")
        if not node.simulated:
            self._thread.start()

    def wait_idle(self) -> None:
        """Wait until the images that have arrived are processed, at most 5 s."""
        self._queue.wait_idle(timeout_s=5.0)

    def close(self) -> None:
        """Process no more images."""
        self._queue.close()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)

    def _on_message(self, message: CompressedImage, info: MessageInfo) -> None:
        missed = self._gaps.before(info)
        if self._node.simulated:
            self._process_now(ImageSample(message, missed, waited=False, behind=0))
        else:
            self._queue.put(message, missed)

    def _process_now(self, sample: ImageSample) -> None:
        if sample.missed:
            self._node.missed(_TOPIC, sample.missed)
        self._process(sample)

    def _run(self) -> None:
        while (sample := self._queue.take()) is not None:
            self._process_now(sample)


class Beside:
    """Where images queue all the same: a thread of the networks' own, for the newest image.

    look : looks at a frame, with its header and whether its keypoints are published

    Attributes
    ----------
    looking : held while the networks look at an image
    seen : the subject in the last image that they looked at here, until it is taken
    published_ns : stamp of the last image whose keypoints are published
    """

    def __init__(self, node: ComponentNode, look: Callable[[Frame, Header, bool], None]) -> None:
        self._look = node.guarded(_TOPIC, look, stamps=False)
        self._thread = node.thread(self._run, "networks")
        self.looking = threading.Lock()
        self.seen: PoseObservation | None = None
        self.published_ns = 0
        self._took_s: deque[float] = deque(maxlen=5)
        self._closed = False
        self._newest: tuple[Frame, Header, bool] | None = None
        self._changed = threading.Condition()

    def took(self, seconds: float) -> None:
        """Record how long the networks took for an image."""
        self._took_s.append(seconds)

    @property
    def slow(self) -> bool:
        """Whether the networks take too long for images to wait for them."""
        return bool(self._took_s) and statistics.median(tuple(self._took_s)) > _SLOW_S

    def offer(self, frame: Frame, header: Header, published: bool) -> bool:
        """Put an image in the place of the one that waits; whether that had no keypoints, and will have none."""
        with self._changed:
            lost = self._newest is not None and not self._newest[2]
            self.published_ns = frame.stamp_ns if published else self.published_ns
            self._newest = frame, header, published
            self._changed.notify_all()
        if not self._thread.is_alive():
            self._thread.start()
        return lost

    def _run(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # not every system has priorities of threads
            here = os.PRIO_PROCESS, threading.get_native_id()
            os.setpriority(*here, os.getpriority(*here) + _BESIDE_NICENESS)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._newest or self._closed)
                newest, self._newest = self._newest, None
            if newest is None or self._closed:
                return
            self._look(*newest)

    def close(self) -> None:
        """Look at no more images."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)


class PoseEstimatorNode(ManagedComponent):
    """Runs detection, subject tracking and 2D pose on images, with less work for each while they queue.

    In simulated time a process of its own looks at them between their exposure and their publication.
    """

    component = "pose_estimator"
    config: PoseEstimatorConfig
    needs = ("image/compressed",)

    def build(self) -> None:
        """Declare endpoints and state."""
        self._estimator: PoseEstimator | None = None
        self._roi: np.ndarray | None = None
        self._ahead: LookAhead | None = None
        self._load_shedding = LoadShedding(self.config.max_load_level)
        self._beside = Beside(self, self._look_beside)
        self._follower: Follower | None = None
        self._shared = SharedImages(self)
        self._pose2d = self.output("pose2d")
        self._background = self.output("background")
        self._images = ImageInput(self, self._on_image, _DEPTH)
        self.input("roi", self._on_roi)

    def acquire(self) -> None:
        """Load the networks."""
        self._estimator = PoseEstimator(models_folder(self.config.models_dir), self.config)
        self._estimator.detector.accepts_other_sizes()  # which takes time, under load most of all
        if self._estimator.limited_use:
            self.details[Key.NETWORKS] = self._estimator.limited_use

    def release(self) -> None:
        """Drop the networks and the subject."""
        self._images.wait_idle()
        self._end_ahead()
        with self._beside.looking:
            self._estimator, self._roi = None, None
        self._shared.close()

    def expect(self, stamp_ns: int, jpeg: Future[bytes]) -> None:
        """Look at a picture that will be published."""
        if self.active:
            self._ahead = self._ahead or LookAhead(self.config)
            roi, self._roi = self._roi, None
            self._ahead.begin(stamp_ns, jpeg, roi)

    def _end_ahead(self) -> None:
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            ahead.close()

    def _on_roi(self, message: RegionOfInterest) -> None:
        x, y = message.x_offset, message.y_offset
        self._roi = np.array([x, y, x + message.width, y + message.height], np.float64)

    def flush(self) -> None:
        """Process the images that have arrived."""
        self._images.wait_idle()
        super().flush()

    def close(self) -> None:
        """Process no more images."""
        self._images.close()
        self._beside.close()
        self._end_ahead()

    def _on_image(self, sample: ImageSample) -> None:
        assert self._estimator is not None, "no message is taken before the node is active"
        level = self.config.max_load_level
        if not (self._load_shedding.lasting >= _BESIDE_LEVEL and self._beside.slow):
            level = self._load_shedding.level(self.now_s(), sample.waited, sample.behind)
        header = sample.message.header
        stamp_ns = stamp_from_ros(header.stamp)
        observation = None if self._ahead is None else self._ahead.take(stamp_ns)
        if observation is None:
            image = self._shared.get(stamp_ns)
            image = image_from_message(sample.message, compressed=True) if image is None else image
            if self._load_shedding.lasting >= _BESIDE_LEVEL:
                self._follow(Frame(stamp_ns, image), header)
                return
            self._follower = self._beside.seen = None
            observation = self._look(image, stamp_ns, level)
        if level:
            self.count(Key.IMAGES_SHED)
        self._publish(observation, header, propagated=self._estimator.propagated)

    def _look(self, image: np.ndarray, stamp_ns: int, level: int, *, looks: bool = False) -> PoseObservation:
        roi, self._roi = self._roi, None
        with self._beside.looking:
            assert self._estimator is not None
            begin_s = time.perf_counter()
            observation = self._estimator.process(image, stamp_ns, roi, level, looks=looks)
            if self._estimator.keypoints is not None:
                self._beside.took(time.perf_counter() - begin_s)
            if looks:
                self._beside.seen = observation
        return observation

    def _follow(self, frame: Frame, header: Header) -> None:
        """Keypoints by optical flow, at once; the networks look at the newest image when they are done."""
        if self._follower is None:
            assert self._estimator is not None
            self._follower = Follower(self._estimator.hand_over())
        seen, self._beside.seen = self._beside.seen, None
        if seen is not None:
            self._follower.correct(seen)
        observation = self._follower.follow(frame)
        if observation is not None:
            self._publish(observation, header, propagated=bool(np.isfinite(observation.keypoints).any()))
        if self._beside.offer(frame, header, published=observation is not None):
            self.missed(_TOPIC, 1)

    def _look_beside(self, frame: Frame, header: Header, published: bool) -> None:
        if self._estimator is None:
            return
        observation = self._look(frame.image, frame.stamp_ns, self.config.max_load_level, looks=True)
        self.count(Key.IMAGES_SHED)
        if published:
            self._publish_points(observation, header)
        elif frame.stamp_ns > self._beside.published_ns:
            self._publish(observation, header)
        else:
            self.missed(_TOPIC, 1)

    def _publish(self, observation: PoseObservation, header: Header, *, propagated: bool = False) -> None:
        if propagated:
            self.count(Key.IMAGES_PROPAGATED)
        self._pose2d.publish(pose2d_to_ros(observation, header.frame_id))
        self._publish_points(observation, header)
        self.count(Key.IMAGES)
        self.produced(observation.stamp_ns)
        if observation.has_subject:
            valid = int(np.isfinite(observation.keypoints).all(axis=-1).sum())
            score, joints = observation.detection_score, len(observation.joints)
            self.details[Key.SUBJECT] = f"{observation.track_id}, score {score:.2f}, {valid} of {joints} joints"
            self.report(OK, "following the subject")
        else:
            self.details[Key.SUBJECT] = "none"
            self.report(WARN, "no subject in view")

    def _publish_points(self, observation: PoseObservation, header: Header) -> None:
        if observation.background is not None and (not self.peers or subscribers_of("background", self.peers)):
            self._background.publish(background_to_ros(observation.background, header))
