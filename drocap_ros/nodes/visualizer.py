"""Node ``visualizer``: the body in RViz, Foxglove and Rerun.

Subscribes ``pose2d``, ``pose3d/initial``, ``pose3d/latest`` and ``vehicle/state``; publishes ``markers/keypoints``
(visualization_msgs/ImageMarker), ``markers/initial``, ``markers/latest`` and ``markers/camera_path``
(visualization_msgs/MarkerArray) and the joints of the newest pose on TF, those of the latest one where it is in
``map``.  With ``human_topics`` it also publishes the subject by REP 155, see :mod:`drocap_ros.ros.markers`.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from visualization_msgs.msg import MarkerArray

from drocap_ros.msg import Pose2D, Pose3D, VehicleState
from drocap_ros.ros.component import OK, WARN, ComponentNode
from drocap_ros.ros.conversions import MAP, pose3d_from_ros, stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.markers import (
    AVAILABLE,
    MISSING,
    HumanTopics,
    body_transforms,
    human_transforms,
    keypoint_marker,
    path_marker,
    pose_markers,
    prefix_of,
)
from drocap_ros.ros.topics import TFMessage
from drocap_ros.view.visualizer_config import RateLimit, VisualizerConfig

#: Time after which a marker of an initial pose without a successor disappears.
INITIAL_LIFETIME_S = 0.5
#: That of an adjusted pose, which stays while the person is hidden for a moment.
LATEST_LIFETIME_S = 3.0
#: Time after a pose in ``map`` in which initial poses, whose place is unknown, are not on TF.
_PLACED_NS = 10**9


class VisualizerNode(ComponentNode):
    """Publishes markers and TF of the poses; no other node depends on it."""

    component = "visualizer"
    config: VisualizerConfig
    needs = ("pose2d", "pose3d/initial")

    def build(self) -> None:
        """Declare endpoints and state."""
        self._keypoints = self.output("markers/keypoints")
        self._initial = self.output("markers/initial")
        self._latest = self.output("markers/latest")
        self._paths = self.output("markers/camera_path")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self._pace = {stage: RateLimit(self.config.marker_rate_hz) for stage in ("initial", "latest")}
        self._path: deque[np.ndarray] = deque(maxlen=self.config.path_points)
        self._path_ns = -(10**18)
        self._placed_ns = -(10**18)  # last pose in ``map``
        # REP 155's topics have no namespace.
        self._prefix = prefix_of(self.get_namespace(), self.config.frame_prefix)
        self._humans = HumanTopics(self, self._prefix) if self.config.human_topics and AVAILABLE else None
        if self.config.human_topics and not AVAILABLE:
            self.get_logger().warning(MISSING)
        self.input("pose2d", self._on_pose2d, newest=True)
        self.input("pose3d/initial", self._on_initial, newest=True)
        self.input("pose3d/latest", self._on_latest, newest=True)
        self.input("vehicle/state", self._on_state)

    def _on_pose2d(self, message: Pose2D) -> None:
        self._keypoints.publish(keypoint_marker(message))
        if self._humans is not None:
            self._humans.publish(message)

    def _on_initial(self, message: Pose3D) -> None:
        pose3d_from_ros(message)  # refuses a malformed pose even when it is not drawn
        if self._pace["initial"].due(stamp_from_ros(message.header.stamp)):
            self._initial.publish(pose_markers(message, INITIAL_LIFETIME_S))
        self._show_frames(message, latest=False)
        self.count(Key.POSES)
        if self.config.human_topics and self._humans is None:
            self.report(WARN, f"drawing; {MISSING}")
        else:
            self.report(OK, "drawing")

    def _show_frames(self, message: Pose3D, *, latest: bool) -> None:
        """Publish the joints on TF: by the latest pose where that is in ``map``, else by the initial one."""
        stamp_ns, placed = stamp_from_ros(message.header.stamp), latest and message.header.frame_id == MAP
        if placed:
            self._placed_ns = stamp_ns
        here = placed or (not latest and abs(stamp_ns - self._placed_ns) > _PLACED_NS)
        if self._tf is None or not here:
            return
        human = human_transforms(message, self._prefix) if self.config.human_topics else []
        if transforms := body_transforms(message, self.config.frame_prefix) + human:
            self._tf.publish(TFMessage(transforms=transforms))

    def _on_latest(self, message: Pose3D) -> None:
        pose3d_from_ros(message)
        if self._pace["latest"].due(stamp_from_ros(message.header.stamp)):
            self._latest.publish(pose_markers(message, LATEST_LIFETIME_S))
        self._show_frames(message, latest=True)

    def _on_state(self, message: VehicleState) -> None:
        stamp_ns = stamp_from_ros(message.header.stamp)
        position = np.asarray(message.position_enu_m)
        if not np.isfinite(position).all() or abs(stamp_ns - self._path_ns) < self.config.path_period_s * 1e9:
            return
        self._path_ns = stamp_ns
        self._path.append(position)
        self._paths.publish(MarkerArray(markers=[path_marker(message.header, np.array(self._path))]))
