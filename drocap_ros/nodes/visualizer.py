"""Node ``visualizer``: the body in RViz, Foxglove and Rerun.

Subscribes ``pose3d/initial``, ``pose3d/latest`` and ``vehicle/state``; publishes ``markers/initial``,
``markers/latest`` and ``markers/camera_path`` (visualization_msgs/MarkerArray) and the joints of the newest pose
on TF.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from visualization_msgs.msg import MarkerArray

from drocap_ros.msg import Pose3D, VehicleState
from drocap_ros.nodes.component import OK, ComponentNode
from drocap_ros.nodes.conversions import stamp_from_ros
from drocap_ros.nodes.markers import body_transforms, path_marker, pose_markers
from drocap_ros.nodes.run import node_main
from drocap_ros.nodes.topics import TFMessage

#: A pose that nobody renews disappears: initial poses come with each picture, refined ones about once a second.
INITIAL_LIFETIME_S, LATEST_LIFETIME_S = 0.5, 3.0


class VisualizerNode(ComponentNode):
    """Draws what the other nodes publish; nothing depends on it."""

    component = "visualizer"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._initial = self.output("markers/initial")
        self._latest = self.output("markers/latest")
        self._paths = self.output("markers/camera_path")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self._path: deque[np.ndarray] = deque(maxlen=self.config.path_points)
        self._path_ns = -(10**18)
        self.input("pose3d/initial", self._on_initial)
        self.input("pose3d/latest", self._on_latest)
        self.input("vehicle/state", self._on_state)

    def _on_initial(self, message: Pose3D) -> None:
        self._initial.publish(pose_markers(message, INITIAL_LIFETIME_S))
        if self._tf is not None and (transforms := body_transforms(message)):
            self._tf.publish(TFMessage(transforms=transforms))
        self.count("poses")
        self.report(OK, "drawing")

    def _on_latest(self, message: Pose3D) -> None:
        self._latest.publish(pose_markers(message, LATEST_LIFETIME_S))

    def _on_state(self, message: VehicleState) -> None:
        stamp_ns = stamp_from_ros(message.header.stamp)
        position = np.asarray(message.position_enu_m)
        if not np.isfinite(position).all() or abs(stamp_ns - self._path_ns) < self.config.path_period_s * 1e9:
            return
        self._path_ns = stamp_ns
        self._path.append(position)
        self._paths.publish(MarkerArray(markers=[path_marker(message.header, np.array(self._path))]))


def main() -> int:
    """Run the node as a process."""
    return node_main(VisualizerNode)


if __name__ == "__main__":
    raise SystemExit(main())
