"""Node ``pose_estimator``: pictures in, the subject's keypoints out.

Subscribes ``image/compressed`` (sensor_msgs/CompressedImage; a camera of the same process hands over arrays), ``roi``
(sensor_msgs/RegionOfInterest, the box of a drone's own tracker); publishes ``pose2d`` (drocap_ros/Pose2D), its header
equal to the picture's.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import RegionOfInterest
from std_msgs.msg import Header

from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import models_folder
from drocap_ros.perception.load_shedding import Hurry
from drocap_ros.recording.pictures import image_from_message
from drocap_ros.ros.component import OK, WARN
from drocap_ros.ros.conversions import pose2d_to_ros, stamp_from_ros
from drocap_ros.ros.image_transport import PictureInput
from drocap_ros.ros.latency import SUBJECT
from drocap_ros.ros.lifecycle import ManagedComponent
from drocap_ros.ros.spin import node_main
from drocap_ros.ros.topics import TOPICS


class PoseEstimatorNode(ManagedComponent):
    """Runs detection, subject tracking and 2D pose on every picture that arrives while it is free."""

    component = "pose_estimator"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._estimator: PoseEstimator | None = None
        self._roi: np.ndarray | None = None
        self._hurry = Hurry(self.config.max_hurry)
        self._pose2d = self.output("pose2d")
        self._pictures = PictureInput(
            self, self._on_image, partial(image_from_message, compressed=True), TOPICS["image/compressed"].qos.depth
        )
        self.input("roi", self._on_roi)
        self.set_up()

    def acquire(self) -> None:
        """Load the networks."""
        self._estimator = PoseEstimator(models_folder(self.config.models_dir or None), self.config)
        if self._estimator.limited_use:
            self.details["networks"] = self._estimator.limited_use

    def release(self) -> None:
        """Forget the networks and the subject."""
        self._pictures.settle()
        self._estimator, self._roi = None, None

    def _on_roi(self, message: RegionOfInterest) -> None:
        x, y = message.x_offset, message.y_offset
        self._roi = np.array([x, y, x + message.width, y + message.height], np.float64)

    def flush(self) -> None:
        """Finish the pictures that have arrived."""
        self._pictures.settle()
        super().flush()

    def close(self) -> None:
        """Take no more pictures."""
        self._pictures.close()

    def _on_image(self, header: Header, image: np.ndarray) -> None:
        assert self._estimator is not None, "no message is taken before the node is active"
        now_s = time.monotonic()
        hurry = self._hurry.level(now_s, self._pictures.waited, self._pictures.behind)
        roi, self._roi = self._roi, None
        observation = self._estimator.process(image, stamp_from_ros(header.stamp), roi, hurry)
        if hurry:
            self.count("images in a hurry: detection only when due")
        if self._estimator.carried:
            self.count("images in a hurry: keypoints of the one before, carried on")
        self._pose2d.publish(pose2d_to_ros(observation, header.frame_id))
        self.count("images")
        self.produced(observation.stamp_ns)
        if observation.has_subject:
            seen = int(np.isfinite(observation.keypoints).all(axis=-1).sum())
            score, joints = observation.detection_score, len(observation.joints)
            self.details[SUBJECT] = f"{observation.track_id}, score {score:.2f}, {seen} of {joints} joints"
        else:
            self.details[SUBJECT] = "none"
        self.report(*((OK, "following the subject") if observation.has_subject else (WARN, "no subject in view")))


def main() -> int:
    """Run the node as a process."""
    return node_main(PoseEstimatorNode)


if __name__ == "__main__":
    raise SystemExit(main())
