"""Node ``initializer``: publishes a first 3D pose of every image.

Subscribes ``pose2d``, and ``camera_info``, whose distortion is taken off; publishes ``pose3d/initial``
(drocap_ros/Pose3D, stage INITIAL) in the camera's frame.  Events of the stream
(:mod:`drocap_ros.reconstruction.live.frame_buffer`) are counted on ``/diagnostics``.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from drocap_ros.geometry.camera_history import CameraHistory
from drocap_ros.msg import Pose2D
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent
from drocap_ros.reconstruction.live.initializer import LiveInitializer
from drocap_ros.recording.pose_messages import add_calibration
from drocap_ros.ros.component import OK, WARN, ComponentNode
from drocap_ros.ros.conversions import pose2d_from_ros, pose3d_to_ros
from drocap_ros.ros.diagnostics import Key, of


class InitializerNode(ComponentNode):
    """Passes every observation to the live initializer."""

    component = "initializer"
    config: InitializerConfig
    needs = ("pose2d",)

    def build(self) -> None:
        """Declare endpoints and state."""
        self._initializer = LiveInitializer(self.config)
        self._initial = self.output("pose3d/initial")
        self._cameras = CameraHistory(0.0)
        self.input("camera_info", partial(add_calibration, self._cameras))
        self.input("pose2d", self._on_pose2d, newest=True)

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = self._cameras.flat(pose2d_from_ros(message))
        if not observation.has_subject:
            self.report(WARN, "no subject in view")
            return
        pose = self._initializer.push(observation)
        event = self._initializer.event
        if event is not StreamEvent.CONTINUED:
            self.count(of(Key.STREAM_EVENT, event.name.lower()))
        if pose is None:
            self.report(WARN, f"image {event}")
            return
        self._initial.publish(pose3d_to_ros(pose, message.header.frame_id))
        self.count(Key.POSES)
        self.produced(observation.stamp_ns)
        if np.isfinite(pose.joints3d).all():
            self.report(OK, "running")
        else:
            self.count(Key.IMAGES_INCOMPLETE)
            self.report(WARN, "too few keypoints in the image")
