"""Node ``mavlink_bridge``: the autopilot's telemetry on topics and TF, and the orbit of the subject.

Subscribes ``pose2d``, ``camera_info``, and ``orbit/status``,
where a second bridge would appear; publishes ``vehicle/state`` (drocap_ros/VehicleState), TF ``map`` -> ``base_link``
and ``map`` -> ``camera_optical``, and ``orbit/status`` (drocap_ros/OrbitStatus); serves ``orbit/command``
(drocap_ros/OrbitCommand).

With ``commands_enabled`` false (the default) it reads only: it sends heartbeats, time synchronization and requests
for telemetry, and refuses every start of an orbit.
"""

from __future__ import annotations

import math
import threading
import time
from functools import partial

import numpy as np
from geometry_msgs.msg import Point, TransformStamped
from sensor_msgs.msg import CameraInfo

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.guardian import GuardianProcess
from drocap_ros.flight.mavlink.link import MavlinkLink
from drocap_ros.flight.mavlink.telemetry_request import LinkStatus
from drocap_ros.flight.orbit.command_checks import Rivals
from drocap_ros.flight.orbit.controller import ControlStatus, OrbitController
from drocap_ros.flight.orbit.states import Command, OperatorCommand, State
from drocap_ros.flight.orbit.watchdog import Watchdog
from drocap_ros.flight.vehicle import VehicleState, optical_orientation
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.msg import OrbitStatus, Pose2D
from drocap_ros.parameters import Values
from drocap_ros.recording.pose_messages import lens_of
from drocap_ros.ros.component import ERROR, OK, WARN, ComponentNode, MessageInfo
from drocap_ros.ros.conversions import (
    MAP,
    fix_to_ros,
    header_at,
    odometry_to_ros,
    pose2d_from_ros,
    stamp_from_ros,
    transform_to_ros,
    vehicle_state_to_ros,
)
from drocap_ros.ros.diagnostics import Key, of
from drocap_ros.ros.rclpy_internals import AnswerKey, PolledService
from drocap_ros.ros.topics import RESULT_QOS, TFMessage
from drocap_ros.srv import OrbitCommand
from drocap_ros.tracks import check_camera_matrix

#: Of a status without a change, s: an operator who joins sees it at once.
_STATUS_PERIOD_S = 0.2
#: Between looks at a simulated link, s: one step of the simulated time (ros/lockstep.py).
_LINK_PERIOD_S = 0.01
#: Requests that one control step takes: thousands a second, and a flood never delays the step.
_MAX_REQUESTS = 100


class MavlinkBridgeNode(ComponentNode):
    """One thread owns the link, one steps the control loop, one watches it; the executor takes keypoints.

    With a simulated link there are no threads: timers of the node's clock take their place, in a fixed order.
    """

    component = "mavlink_bridge"
    config: MavlinkBridgeConfig

    def build(self) -> None:
        """Declare endpoints and state."""
        if self.simulated and self.config.commands_enabled and self.transport is None:
            raise InputError(
                "mavlink_bridge.use_sim_time: expected false with commands_enabled, because the autopilot on "
                f"{self.config.url} flies in real time; set one of the two to false"
            )
        self._stepped = self.transport is not None
        self._link = MavlinkLink(self.config, self.now_ns, monotonic_s=self.now_s, transport=self.transport)
        self._watchdog = Watchdog(self._link.send_unlocked, self.config.watchdog_s, self._link.hand_over)
        self._guardian: GuardianProcess | None = None
        self.controller = OrbitController(self._link, self.config, self._watchdog)
        self._states = self.output("vehicle/state")
        self._derived = ((self.output("vehicle/odometry"), odometry_to_ros), (self.output("vehicle/fix"), fix_to_ros))
        self._statuses = self.output("orbit/status")
        self._tf = self.output("/tf") if TFMessage is not None else None
        self.input("camera_info", self._on_camera_info)
        self.input("pose2d", self._on_pose2d, with_info=True)
        self.input("orbit/status", self._on_status)
        self._rivals = Rivals(self.get_namespace())
        self.requests = PolledService(self, OrbitCommand, "orbit/command", RESULT_QOS)
        self._unanswered: list[tuple[OperatorCommand, OrbitCommand.Request, AnswerKey]] = []
        self._last_command: Values = {"command": OrbitStatus.NO_COMMAND}
        self.create_timer(1.0, self._on_second)
        self._lens: CameraModel | None = None
        self._stop = threading.Event()
        self._reported: tuple[State, str] | None = None
        self._reported_s = -math.inf
        # An error in either ends the node: a bridge that hears nothing must not stay.
        self._threads = [
            self.thread(partial(self._link.run, self._on_state, self._stop), "mavlink"),
            self.thread(self._control, "flight-control"),
        ]

    def on_ready(self) -> None:
        """Start reading telemetry and answering commands."""
        if self._stepped:
            self.create_timer(_LINK_PERIOD_S, self._read_link)
            self.create_timer(1.0 / self.config.control_hz, self._control_step)
            return
        for thread in self._threads:
            thread.start()
        self._watchdog.start(self.now_s)
        if self.config.commands_enabled:
            self._guardian = GuardianProcess(self.config.watchdog_s)
            self._link.guardian = self._guardian.take

    def on_stop(self) -> None:
        """End a running orbit by a hold at once, before the shutdown waits for other nodes."""
        if self.controller.safety.state != State.ORBITING:
            return
        self.controller.command(OperatorCommand(int(Command.STOP)))
        if self._stepped:
            self._control_step()
        elif self._threads[1].is_alive():
            time.sleep(3.0 / self.config.control_hz)

    def close(self) -> None:
        """End a running orbit, stop reading and close the port."""
        self.on_stop()
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=5.0)
        self._watchdog.close()
        self.requests.close()
        if self._guardian is not None:
            self._guardian.close()
        self._link.close()

    def _control(self) -> None:
        """Step the controller at its rate.  An error in it holds the vehicle at once, and ends the node."""
        period_s = 1.0 / self.config.control_hz
        due_s = time.monotonic()
        while not self._stop.is_set():
            try:
                self._control_step()
            except Exception as error:  # noqa: BLE001 -- whatever it is, the vehicle holds
                self._watchdog.hold()
                self.failure = error
                return
            due_s = max(due_s + period_s, time.monotonic())
            self._stop.wait(due_s - time.monotonic())

    def _control_step(self) -> None:
        self._take_commands()
        self.controller.intruder = self._rivals.condition(self.now_s())
        status = self.controller.step(self.now_ns(), self.now_s())
        self._answer_commands(status)
        self._report_status(status)

    def _read_link(self) -> None:
        for state in self._link.spin_once():
            self._on_state(state)
        self._watchdog.step(self.now_s())

    def _take_commands(self) -> None:
        # All that wait, so that a stop precedes the others; a flood must not delay the step.
        for _ in range(_MAX_REQUESTS):
            if (taken := self.requests.take()) is None:
                return
            request, header = taken
            command = OperatorCommand(
                int(request.command),
                float(request.radius_m),
                float(request.height_m),
                float(request.angular_speed_deg_s),
                stamp_from_ros(request.stamp),
            )
            self._unanswered.append((command, request, header))
            self.controller.command(command)

    def _answer_commands(self, status: ControlStatus) -> None:
        for command, answer in status.answers:
            code, words = int(answer.condition.code), str(answer.condition)
            response = OrbitCommand.Response(accepted=answer.accepted, condition=code, words=words)
            last: Values = {
                "command": command.kind,
                "command_accepted": answer.accepted,
                "command_condition": code,
                "command_answer": words,
            }
            for entry in self._unanswered:
                if entry[0] is command:
                    last["command_stamp"] = entry[1].stamp
                    self.requests.answer(entry[2], response)
            self._unanswered = [entry for entry in self._unanswered if entry[0] is not command]
            if command.kind != Command.PRESENT:  # a sign changes nothing
                self.count(Key.ORBIT_COMMANDS if answer.accepted else Key.ORBIT_COMMANDS_REFUSED)
                self._last_command = last
                self._publish_status(status)

    def _report_status(self, status: ControlStatus) -> None:
        """Publish every change at once, except while idle, and else five times a second."""
        now_s, reported = self.now_s(), (status.state, status.reason)
        changed = reported != self._reported and status.state != State.IDLE
        if not status.answers and (changed or abs(now_s - self._reported_s) >= _STATUS_PERIOD_S):
            self._reported, self._reported_s = reported, now_s
            self._publish_status(status)

    def _on_state(self, state: VehicleState) -> None:
        self.controller.on_state(state)
        self._states.publish(vehicle_state_to_ros(state))
        for output, message in self._derived:
            if output.get_subscription_count():
                output.publish(message(state))
        self.count(Key.VEHICLE_STATES)
        if self._tf is not None:
            transforms = vehicle_transforms(state)
            if transforms:
                self._tf.publish(TFMessage(transforms=transforms))

    def _on_pose2d(self, message: Pose2D, info: MessageInfo) -> None:
        self._rivals.take_pose2d(info["publication_sequence_number"] or 0, self.now_s())
        observation = pose2d_from_ros(message)
        calibrated = observation.image_size if self._lens is None else self._lens.size
        if all(calibrated) and observation.image_size != calibrated:
            expected, got = (f"{width}x{height}" for width, height in (calibrated, observation.image_size))
            raise InputError(
                f"pose2d: expected images of {expected} as in camera_info, got {got}: every distance would be wrong; "
                "publish the camera_info of these images"
            )
        self.controller.on_pose2d(observation if self._lens is None else self._lens.flat(observation))
        if observation.has_subject:
            self.count(Key.SUBJECT_SEEN)

    def _on_status(self, message: OrbitStatus) -> None:
        self._rivals.take_status(stamp_from_ros(message.header.stamp), self.now_s())

    def _on_camera_info(self, message: CameraInfo) -> None:
        lens, unknown = lens_of(message)
        assert lens is not None, "a message of ROS 2 has nine numbers"
        if all(lens.size):
            check_camera_matrix(lens.matrix, lens.size)
        self.controller.on_camera(lens.matrix)
        self._lens = lens
        if unknown:
            raise InputError(unknown)

    def _on_second(self) -> None:
        if self._guardian is not None:
            self._guardian.revive()
        publishers = self.get_publishers_info_by_topic(self.resolve_topic_name("pose2d"))
        self._rivals.set_names(f"{p.node_namespace.rstrip('/')}/{p.node_name}" for p in publishers)
        status = self._link.status()
        self._report_state(status)
        for name, (real, _) in status.rates_hz.items():
            self.details[of(Key.STREAM_RATE, name)] = f"{real:.1f}"
        self.details[Key.MAVLINK_BAD] = str(status.bad_count)
        self.details[Key.ROUND_TRIP] = f"{status.round_trip_s:.3f}"
        if self.config.signing_key_file:
            self.details[Key.MAVLINK_UNSIGNED] = str(status.refused_count)
        for name, value in self._link.settings.reported().items():
            self.details[name] = f"{value:g}"

    def _report_state(self, status: LinkStatus) -> None:
        """The link first, then the safety machine, then settings; what is well says what the node does."""
        safety = self.controller.safety
        if not status.connected:
            silence = "never heard" if np.isinf(status.silence_s) else f"silent for {status.silence_s:.0f} s"
            remedy = "check the link and its URL"
            if status.refused_count:
                remedy = f"{status.refused_count} messages are not signed with the key of signing_key_file"
            self.report(WARN, f"no autopilot on {self.config.url}: {silence}; {remedy}")
        elif safety.state in (State.HOLDING, State.TAKEN_OVER, State.FAULT):
            self.report(ERROR if safety.state == State.FAULT else WARN, f"{safety.state.name.lower()}: {safety.reason}")
        elif warning := status.warning():
            self.report(WARN, warning)
        elif self._link.settings.warning():
            self.report(WARN, self._link.settings.warning())
        else:
            doing = f"{safety.state.name.lower()}: {safety.reason}"
            if not self.config.commands_enabled:
                doing = "reading telemetry; commands_enabled is false, so it moves nothing"
            self.report(OK, doing + ("" if self._tf else "; tf2_msgs is not installed, so no TF"))

    def _publish_status(self, status: ControlStatus) -> None:
        x, y, z = (float(v) for v in status.subject_position)
        now_ns = self.now_ns()
        self._rivals.published_status(now_ns)
        self._statuses.publish(
            OrbitStatus(
                header=header_at(now_ns, "map"),
                state=int(status.state),
                condition=int(status.condition.code),
                reason=status.reason,
                radius_m=float(status.radius_m),
                height_m=float(status.height_m),
                angular_speed_deg_s=float(status.angular_speed_deg_s),
                radius_error_m=float(status.radius_error_m),
                yaw_error_deg=float(status.yaw_error_deg),
                subject_position_m=Point(x=x, y=y, z=z),
                **self._last_command,
            )
        )


def vehicle_transforms(state: VehicleState) -> list[TransformStamped]:
    """``map`` -> ``base_link`` and, with a mount, ``map`` -> ``camera_optical``; none while the position is unknown."""
    if not np.isfinite(state.position_enu_m).all():
        return []
    camera = optical_orientation(state.gimbal_orientation_xyzw)
    return [
        transform_to_ros(header_at(state.stamp_ns, MAP), child, state.position_enu_m, xyzw)
        for child, xyzw in (("base_link", state.orientation_xyzw), ("camera_optical", camera))
        if np.isfinite(xyzw).all()
    ]
