"""Node ``mavlink_bridge``: the autopilot's telemetry on topics and TF.

Subscribes ``pose2d`` and ``orbit/command``; publishes ``vehicle/state`` (drocap_ros/VehicleState), TF
``map`` -> ``base_link`` and ``map`` -> ``camera_optical``, and ``orbit/status`` (drocap_ros/OrbitStatus).

It reads only.  It sends heartbeats, time synchronization and requests for telemetry, and answers every
command to orbit with a refusal that says so.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, TransformStamped, Vector3

from drocap_ros.flight.frames import OPTICAL_FROM_FLU
from drocap_ros.flight.link import MavlinkLink
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from drocap_ros.msg import OrbitCommand, OrbitStatus, Pose2D
from drocap_ros.nodes.component import OK, WARN, ComponentNode
from drocap_ros.nodes.conversions import header_at, pose2d_from_ros, quaternion_to_ros, vehicle_state_to_ros
from drocap_ros.nodes.run import node_main
from drocap_ros.nodes.topics import TFMessage

REFUSAL = "this version of drocap_ros reads telemetry only and commands no motion; fly the orbit by hand"


class MavlinkBridgeNode(ComponentNode):
    """One thread owns the link; the node turns its states into messages."""

    component = "mavlink_bridge"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._link = MavlinkLink(self.config, lambda: self.get_clock().now().nanoseconds)
        self._states = self.output("vehicle/state")
        self._statuses = self.output("orbit/status")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self.input("pose2d", self._on_pose2d)
        self.input("orbit/command", self._on_command)
        self.create_timer(1.0, self._on_second)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)

    def on_start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading and give the port back."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self._link.close()

    def _run(self) -> None:
        self._link.run(self._on_state, self._stop)

    def _on_state(self, state: VehicleState) -> None:
        self._states.publish(vehicle_state_to_ros(state))
        self.count("vehicle states")
        if self._tf is not None:
            transforms = vehicle_transforms(state)
            if transforms:
                self._tf.publish(TFMessage(transforms=transforms))

    def _on_pose2d(self, message: Pose2D) -> None:
        if pose2d_from_ros(message).has_subject:
            self.count("subject seen")

    def _on_command(self, message: OrbitCommand) -> None:
        self.count("orbit commands refused")
        self._publish_status(REFUSAL)

    def _on_second(self) -> None:
        status = self._link.status()
        if not status.connected:
            silence = "never heard" if np.isinf(status.silence_s) else f"silent for {status.silence_s:.0f} s"
            self.report(WARN, f"no autopilot on {self.config.url}: {silence}; check the link and its URL")
        elif status.refused:
            self.report(WARN, f"the autopilot refuses to send {', '.join(sorted(status.refused))}")
        else:
            self.report(OK, "reading telemetry" + ("" if self._tf else "; no tf2_msgs here, so no TF"))
        for name, (real, _) in status.rates_hz.items():
            self.details[f"{name} Hz"] = f"{real:.1f}"
        self.details["bad MAVLink data"] = str(status.bad_count)
        self._publish_status("reading telemetry only")

    def _publish_status(self, reason: str) -> None:
        nan = float("nan")
        self._statuses.publish(
            OrbitStatus(
                header=header_at(self.get_clock().now().nanoseconds, "map"),
                state=OrbitStatus.IDLE,
                reason=reason,
                radius_m=nan,
                height_m=nan,
                angular_speed_deg_s=nan,
                radius_error_m=nan,
                yaw_error_deg=nan,
                subject_position_m=Point(x=nan, y=nan, z=nan),
            )
        )


def vehicle_transforms(state: VehicleState) -> list[TransformStamped]:
    """``map`` -> ``base_link`` and, with a mount, ``map`` -> ``camera_optical``; none while the position is unknown."""
    if not np.isfinite(state.position_enu_m).all():
        return []
    transforms = []
    for child, xyzw, turn in (
        ("base_link", state.orientation_xyzw, np.eye(3)),
        ("camera_optical", state.gimbal_orientation_xyzw, OPTICAL_FROM_FLU.T),
    ):
        if np.isfinite(xyzw).all():
            transform = TransformStamped(header=header_at(state.stamp_ns, "map"), child_frame_id=child)
            x, y, z = (float(v) for v in state.position_enu_m)
            transform.transform.translation = Vector3(x=x, y=y, z=z)
            rotation = quaternion_from_matrix(matrix_from_quaternion(xyzw) @ turn)
            transform.transform.rotation = quaternion_to_ros(rotation)
            transforms.append(transform)
    return transforms


def main() -> int:
    """Run the node as a process."""
    return node_main(MavlinkBridgeNode)


if __name__ == "__main__":
    raise SystemExit(main())
