"""Node ``mavlink_bridge``: the autopilot's telemetry on topics and TF, and the orbit of the subject.

Subscribes ``pose2d``, ``camera_info`` and ``orbit/command``; publishes ``vehicle/state`` (drocap_ros/VehicleState),
TF ``map`` -> ``base_link`` and ``map`` -> ``camera_optical``, and ``orbit/status`` (drocap_ros/OrbitStatus).

With ``commands_enabled`` false (the default) it reads only: it sends heartbeats, time synchronization and requests
for telemetry, and answers every command to orbit with a refusal that says so.
"""

from __future__ import annotations

import math
import threading
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, TransformStamped, Vector3
from sensor_msgs.msg import CameraInfo

from drocap_ros.flight.frames import optical_orientation
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.orbit.controller import ControlStatus, OperatorCommand, OrbitController
from drocap_ros.flight.orbit.safety import State
from drocap_ros.flight.orbit.watchdog import Watchdog
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.msg import OrbitCommand, OrbitStatus, Pose2D
from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode
from drocap_ros.ros.conversions import (
    header_at,
    pose2d_from_ros,
    quaternion_to_ros,
    stamp_from_ros,
    vehicle_state_to_ros,
)
from drocap_ros.ros.spin import node_main
from drocap_ros.ros.topics import TFMessage

_STATUS_PERIOD_S = 0.2


class MavlinkBridgeNode(ComponentNode):
    """One thread owns the link, one steps the control loop, one watches it; the node turns states to messages."""

    component = "mavlink_bridge"

    def __init__(self, config: Any = None, **node_kwargs: Any) -> None:
        super().__init__(config, **node_kwargs)
        self._link = MavlinkLink(self.config, lambda: self.get_clock().now().nanoseconds)
        self._watchdog = Watchdog(self._link.send_unlocked, self.config.watchdog_s)
        self._controller = OrbitController(self._link, self.config, self._watchdog)
        self._states = self.output("vehicle/state")
        self._statuses = self.output("orbit/status")
        self._tf = self.output("/tf") if TFMessage is not None else None
        # What comes with every picture is looked at when the control loop has need of it, and wakes nobody before.
        self._camera_infos = self.input("camera_info", self._on_camera_info, polled=True)
        self._poses = self.input("pose2d", self._on_pose2d, polled=True)
        self.input("orbit/command", self._on_command)
        self.create_timer(1.0, self._on_second)
        self._stop = threading.Event()
        self._failure: BaseException | None = None
        self._told: tuple[State, str] | None = None
        self._told_s = -math.inf
        self._threads = [
            threading.Thread(target=self._link.run, args=(self._on_state, self._stop), name="mavlink", daemon=True),
            threading.Thread(target=self._control, name="flight-control", daemon=True),
        ]

    def on_start(self) -> None:
        """Begin to read, and to answer commands."""
        for thread in self._threads:
            thread.start()
        self._watchdog.start()

    def on_stop(self) -> None:
        """End a running orbit by a hold, before anything is waited for: whoever waits may stop the control loop."""
        if self._threads[1].is_alive() and self._controller.safety.state == State.ORBITING:
            self._controller.command(OperatorCommand(kind=OrbitCommand.STOP))
            time.sleep(3.0 / self.config.control_hz)

    def close(self) -> None:
        """End a running orbit, stop reading and give the port back."""
        self.on_stop()
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self._watchdog.close()
        self._link.close()

    def _control(self) -> None:
        """Step the controller at its rate.  An error in it ends the node; the watchdog holds the vehicle."""
        period_s = 1.0 / self.config.control_hz
        due_s = time.monotonic()
        while not self._stop.is_set():
            try:
                # A flood of messages must not keep the loop from its step.
                for subscription in (self._camera_infos, self._poses):
                    self.poll(subscription, within_s=0.2 * period_s)
                status = self._controller.step(self.get_clock().now().nanoseconds, time.monotonic())
                self._tell(status)
            except Exception as error:
                self._failure = error
                return
            due_s = max(due_s + period_s, time.monotonic())
            self._stop.wait(due_s - time.monotonic())

    def _tell(self, status: ControlStatus) -> None:
        """Publish every answer and every change at once, the rest a few times a second."""
        now_s, told = time.monotonic(), (status.state, status.reason)
        if status.answer:
            self.count("orbit commands refused" if status.answer.startswith("refused") else "orbit commands")
            self._publish_status(status, status.answer)
        elif (told != self._told and status.state != State.IDLE) or now_s - self._told_s >= _STATUS_PERIOD_S:
            self._told, self._told_s = told, now_s
            self._publish_status(status, status.reason)

    def _on_state(self, state: VehicleState) -> None:
        self._controller.on_state(state)
        self._states.publish(vehicle_state_to_ros(state))
        self.count("vehicle states")
        if self._tf is not None:
            transforms = vehicle_transforms(state)
            if transforms:
                self._tf.publish(TFMessage(transforms=transforms))

    def _on_pose2d(self, message: Pose2D) -> None:
        observation = pose2d_from_ros(message)
        self._controller.on_pose2d(observation)
        if observation.has_subject:
            self.count("subject seen")

    def _on_camera_info(self, message: CameraInfo) -> None:
        self._controller.on_camera(np.array(message.k, dtype=float).reshape(3, 3))

    def _on_command(self, message: OrbitCommand) -> None:
        self._controller.command(
            OperatorCommand(
                int(message.command), float(message.radius_m), float(message.height_m),
                float(message.angular_speed_deg_s), stamp_from_ros(message.header.stamp),
            )
        )  # fmt: skip

    def _on_second(self) -> None:
        if self._failure is not None:
            raise self._failure
        status = self._link.status()
        safety = self._controller.safety
        if not status.connected:
            silence = "never heard" if np.isinf(status.silence_s) else f"silent for {status.silence_s:.0f} s"
            remedy = "check the link and its URL"
            if status.refused_count:
                remedy = f"{status.refused_count} messages came that are not signed with the key of signing_key_file"
            self.report(WARN, f"no autopilot on {self.config.url}: {silence}; {remedy}")
        elif safety.state in (State.HOLDING, State.TAKEN_OVER, State.FAULT):
            self.report(ERROR if safety.state == State.FAULT else WARN, f"{safety.state.name.lower()}: {safety.reason}")
        elif status.refused:
            self.report(WARN, f"the autopilot refuses to send {', '.join(sorted(status.refused))}")
        elif self._link.settings.warning():
            self.report(WARN, self._link.settings.warning())
        else:
            doing = "reading telemetry" if not self.config.commands_enabled else safety.state.name.lower()
            self.report(OK, doing + ("" if self._tf else "; no tf2_msgs here, so no TF"))
        for name, (real, _) in status.rates_hz.items():
            self.details[f"{name} Hz"] = f"{real:.1f}"
        self.details["bad MAVLink data"] = str(status.bad_count)
        if self.config.signing_key_file:
            self.details["MAVLink messages not signed with our key"] = str(status.refused_count)
        for name, value in self._link.settings.told().items():
            self.details[name] = f"{value:g}"

    def _publish_status(self, status: ControlStatus, reason: str) -> None:
        x, y, z = (float(v) for v in status.subject_position)
        self._statuses.publish(
            OrbitStatus(
                header=header_at(self.get_clock().now().nanoseconds, "map"),
                state=int(status.state),
                reason=reason,
                radius_m=float(status.radius_m),
                height_m=float(status.height_m),
                angular_speed_deg_s=float(status.angular_speed_deg_s),
                radius_error_m=float(status.radius_error_m),
                yaw_error_deg=float(status.yaw_error_deg),
                subject_position_m=Point(x=x, y=y, z=z),
            )
        )


def vehicle_transforms(state: VehicleState) -> list[TransformStamped]:
    """``map`` -> ``base_link`` and, with a mount, ``map`` -> ``camera_optical``; none while the position is unknown."""
    if not np.isfinite(state.position_enu_m).all():
        return []
    x, y, z = state.position_enu_m.tolist()
    transforms = []
    for child, xyzw in (
        ("base_link", state.orientation_xyzw),
        ("camera_optical", optical_orientation(state.gimbal_orientation_xyzw)),
    ):
        if np.isfinite(xyzw).all():
            transform = TransformStamped(header=header_at(state.stamp_ns, "map"), child_frame_id=child)
            transform.transform.translation = Vector3(x=x, y=y, z=z)
            transform.transform.rotation = quaternion_to_ros(xyzw)
            transforms.append(transform)
    return transforms


def main() -> int:
    """Run the node as a process."""
    return node_main(MavlinkBridgeNode)


if __name__ == "__main__":
    raise SystemExit(main())
