"""A simulated copter under setpoints, modes, time-outs, refusals and failsafes of ArduPilot or PX4.

ArduPilot's behaviour was measured on its own simulation, PX4's is taken from its documentation and source.  The copter
reports its estimate: the truth with the errors of GPS and attitude.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.frames import ned_to_enu
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.simulation.vehicle.dynamics import PointMass, Target
from drocap_ros.simulation.vehicle.flight_path import VehiclePose
from drocap_ros.simulation.vehicle.mavlink_vehicle import SimulatedVehicle

_STEP_S = 0.01
_MODES = {
    "ardupilot": {
        "STABILIZE": 0, "ALT_HOLD": 2, "GUIDED": 4, "LOITER": 5, "RTL": 6, "LAND": 9, "POSHOLD": 16, "BRAKE": 17,
    },
    "px4": {
        "POSCTL": 3 << 16, "OFFBOARD": 6 << 16, "LOITER": 4 << 16 | 3 << 24, "RTL": 4 << 16 | 5 << 24,
        "LAND": 4 << 16 | 6 << 24, "ALTCTL": 2 << 16,
    },
}  # fmt: skip
#: The mode in which setpoints steer.
CONTROL_MODE = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}
#: Deceleration of the stop in each mode: the measured distances from 2 m/s, less what the lag takes.
_BRAKING = {"BRAKE": 0.92, "LOITER": 2.6}
_PX4_STREAM_S, _PX4_GAP_S = 1.0, 0.5
_GPS_NOTICED_S, _EKF_NOTICED_S = 0.4, 7.4
_HEALTHY, _CONSTANT_POSITION = 831, 831 & ~(8 | 16) | 128


class SimulatedCopter(SimulatedVehicle):
    """A MAVLink vehicle with the dynamics of a copter.

    Parameters
    ----------
    position, yaw : of the initial hover, ENU, truth
    wind : (3,) m/s
    guid_timeout_s : ArduPilot's GUID_TIMEOUT
    offboard_loss_s : PX4's COM_OF_LOSS_T; 1 s as PX4 ships
    gps_noise_m : of the slow error of the position; fine errors are added
    """

    def __init__(
        self, transport: Transport, position: np.ndarray, yaw: float, autopilot: str = "ardupilot", *,
        wind: np.ndarray | None = None, seed: int = 0, gps_noise_m: float = 0.4, attitude_error_deg: float = 0.4,
        guid_timeout_s: float = 0.5, mode: str = "LOITER", gimbal: bool = True, gimbal_pitch_deg: float = -14.0,
        offboard_loss_s: float = 0.5,
    ) -> None:  # fmt: skip
        super().__init__("", None, autopilot, gimbal=gimbal, transport=transport)
        self.body = PointMass(position, yaw, np.zeros(3) if wind is None else wind, seed)
        self.mode, self.armed, self.battery, self.landed_state = mode, True, 87, mavlink.MAV_LANDED_STATE_IN_AIR
        self.guid_timeout_s, self.offboard_loss_s = guid_timeout_s, offboard_loss_s
        timeout = {"COM_OF_LOSS_T": offboard_loss_s} if autopilot == "px4" else {"GUID_TIMEOUT": guid_timeout_s}
        self.settings.update(timeout)
        self.denied_modes: frozenset[str] = frozenset()
        self.gps_lost_s = self.ekf_failed_s = math.inf
        self.frozen = False  # telemetry repeats its last values, with fresh or old stamps
        self.frozen_clock = False
        self.crashed = ""
        self.accepted_setpoints = 0
        self.deaf = False  # ignores setpoints silently
        self.motion_until_s = -1.0  # last motion by setpoints
        self.fence_m = math.inf
        self.camera_pitch = math.radians(gimbal_pitch_deg)
        self.mode_log: list[tuple[float, str, str]] = [(0.0, mode, "start")]
        self._t = 0.0
        self._rng = np.random.default_rng([seed, 0xC0])
        self._gps_noise_m = gps_noise_m
        self.gps_error = gps_noise_m * self._rng.standard_normal(3) * np.array([1, 1, 0.5])
        self._attitude_error = math.radians(attitude_error_deg) * self._rng.standard_normal(3)
        self.target = Target(position=position.astype(float).copy(), yaw=yaw)
        self._accepted_s = -1e9  # last accepted setpoint
        self._stream_s = math.inf  # first setpoint after the last gap
        self._setpoint_s = 0.0  # last setpoint, accepted or not
        self._stop_velocity: np.ndarray | None = None
        self._heading = yaw  # held in the modes without setpoints
        self._timed_out_at: Target | None = None
        self._report: VehiclePose | None = None
        self._report_s = -1.0

    def fly(self, t_s: float) -> None:
        """Fly up to path time ``t_s``, then send and receive."""
        while self._t < t_s - 1e-9 and not self.crashed:
            dt = min(_STEP_S, t_s - self._t)
            self._t += dt
            self._failsafes()
            self.body.step(self._present_target(dt), dt)
            decay = math.exp(-dt / 20.0)
            noise = self._gps_noise_m * math.sqrt(1 - decay**2)
            self.gps_error = decay * self.gps_error + noise * self._rng.standard_normal(3) * np.array([1, 1, 0.5])
            if self._t > self.gps_lost_s:
                self.gps_error = self.gps_error + 0.15 * dt * np.array([1.0, 0.5, 0.0])  # dead reckoning drifts
        if not self.crashed:
            self.step(t_s)

    def set_mode(self, mode: str, by: str) -> None:
        """Change the mode; ``by`` ("pilot", "command", "failsafe: ...") enters the log."""
        if mode != self.mode:
            self.mode = mode
            self.mode_log.append((self._t, mode, by))
            self._stop_velocity = self.body.velocity.copy()
            self._heading = self.body.yaw
            if mode == CONTROL_MODE[self.autopilot] and self.autopilot == "ardupilot":
                self._accepted_s = -1e9  # GUIDED starts with a hold
                self.target = Target(yaw=self.body.yaw)

    @property
    def estimate(self) -> np.ndarray:
        """(3,) m, the autopilot's position estimate."""
        return self.body.position + self.gps_error

    def camera_orientation(self) -> np.ndarray:
        """(4,) camera FLU -> ENU, truth: level, in the vehicle's heading, at the mount's pitch."""
        return _level(self.body.yaw, self.camera_pitch)

    def _present_target(self, dt: float) -> Target:
        if self.mode == CONTROL_MODE[self.autopilot]:
            silent_s = self._t - self._accepted_s
            expired = self.autopilot == "ardupilot" and silent_s > self.guid_timeout_s
            if float(np.linalg.norm(self.target.velocity)) > 0.05 and not expired:
                self.motion_until_s = self._t
            if self.autopilot == "ardupilot":
                if silent_s <= self.guid_timeout_s:
                    if self.target.position is not None:
                        self.target.position = self.target.position + self.target.velocity * dt
                    self._timed_out_at = None
                    return self._in_truth(self.target)
                if self._timed_out_at is None:
                    self._timed_out_at = Target(position=self.estimate, yaw=self.body.yaw)
                return self._in_truth(self._timed_out_at)
            return self._in_truth(self.target)
        if self.mode in ("LAND", "RTL"):
            target = self._stopping(1.45, dt)
            target.velocity = np.array([target.velocity[0], target.velocity[1], -0.5 if self.mode == "LAND" else 0.5])
            target.position = None
            return target
        return self._stopping(_BRAKING.get(self.mode, 1.45), dt)

    def _in_truth(self, target: Target) -> Target:
        """Target relative to the truth: the loops close on the estimate, whose error shifts the target."""
        position = None if target.position is None else target.position - self.gps_error
        return Target(position, target.velocity, target.acceleration, target.yaw, target.yaw_rate)

    def _stopping(self, braking: float, dt: float) -> Target:
        """Brake at this deceleration, then hold the position."""
        if self._stop_velocity is None:
            self._stop_velocity = self.body.velocity.copy()
        speed = float(np.linalg.norm(self._stop_velocity))
        if speed > 1e-3:
            self._stop_velocity = self._stop_velocity * max(1 - braking * dt / speed, 0.0)
            self.target = Target(velocity=self._stop_velocity, yaw=self._heading)
        elif self.target.position is None and float(np.linalg.norm(self.body.velocity)) < 0.2:
            self.target = Target(position=self.body.position + self.gps_error, yaw=self._heading)
        elif self.target.position is not None:
            return self._in_truth(self.target)
        else:
            self.target = Target(yaw=self._heading)
        return self.target

    def _failsafes(self) -> None:
        if self.autopilot == "px4" and self.mode == "OFFBOARD" and self._t - self._setpoint_s > self.offboard_loss_s:
            self.set_mode("LOITER", "failsafe: offboard lost")
        if self._t > min(self.ekf_failed_s + 1.0, self.gps_lost_s + _EKF_NOTICED_S + 1.0) and self.mode != "LAND":
            self.set_mode("LAND", "failsafe: estimator")
        if np.hypot(*self.estimate[:2]) > self.fence_m and self.mode not in ("RTL", "LAND"):
            self.set_mode("RTL", "failsafe: fence")

    def _answer(self, message: Any, t_s: float) -> None:
        name = message.get_type()
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            self._take_setpoint(message)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_DO_SET_MODE:
            self._acknowledge(message, self._change_mode(int(message.param2), int(message.param3)))
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW:
            if self.gimbal and math.isfinite(message.param1):
                self.camera_pitch = math.radians(min(max(message.param1, -90.0), 30.0))
            self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED if self.gimbal else mavlink.MAV_RESULT_FAILED)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self.armed = message.param1 > 0.5
            self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED)
        else:
            super()._answer(message, t_s)

    def _acknowledge(self, message: Any, result: int) -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        self._send(self._mav.command_ack_encode(message.command, result, 0, 0, *sender))

    def _change_mode(self, main: int, sub: int) -> int:
        number = main if self.autopilot == "ardupilot" else main << 16 | sub << 24
        names = [name for name, value in _MODES[self.autopilot].items() if value == number]
        if not names:
            return int(mavlink.MAV_RESULT_FAILED)
        streams = self._t - self._stream_s >= _PX4_STREAM_S and self._t - self._setpoint_s < _PX4_GAP_S
        if names[0] in self.denied_modes or (names[0] == "OFFBOARD" and not streams):
            return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        self.set_mode(names[0], "command")
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _take_setpoint(self, m: Any) -> None:
        if m.target_system not in (0, self._mav.srcSystem):
            return
        values = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate)
        if self._t - self._setpoint_s > _PX4_GAP_S:
            self._stream_s = self._t
        self._setpoint_s = self._t
        if self.mode != CONTROL_MODE[self.autopilot] or self.deaf:
            return
        if not all(math.isfinite(v) for v in (*values[:3], m.yaw)):
            self.crashed = "a setpoint with NaN"
            return
        if not all(map(math.isfinite, values)) or m.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            self.target = Target(yaw=self.body.yaw)
            return
        mask = m.type_mask
        vectors = [ned_to_enu(np.array(values[i : i + 3])) for i in (0, 3, 6)]
        keep = [not mask & bit for bit in (1, 8, 64)]
        yaw = None if mask & 1024 else math.remainder(math.pi / 2 - m.yaw, 2 * math.pi)
        self.target = Target(
            vectors[0] if keep[0] else None, vectors[1] if keep[1] else np.zeros(3),
            vectors[2] if keep[2] else np.zeros(3), yaw, 0.0 if mask & 2048 else -m.yaw_rate,
        )  # fmt: skip
        self._accepted_s = self._t
        self.accepted_setpoints += 1

    def at(self, t_s: float) -> VehiclePose:
        """Reported pose: the estimate, not the truth."""
        if self._report is not None and (self.frozen or t_s == self._report_s):
            return self._report
        fine = self._rng.standard_normal(6)
        _, pitch, yaw = self._attitude_error
        tilt = _level(self.body.yaw + yaw, self.camera_pitch + pitch)
        self._report_s = t_s
        self._report = VehiclePose(
            self.estimate + 0.01 * fine[:3], self.body.velocity + 0.04 * fine[3:], self.body.orientation_xyzw(),
            np.array([0.0, 0.0, self.body.yaw_rate]), tilt,
        )  # fmt: skip
        return self._report

    def _send(self, message: Any) -> None:
        if message is not None:
            super()._send(message)

    def _known(self) -> frozenset[int]:
        more = {mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED}
        return super()._known() | more

    def _telemetry(self, number: int, t_s: float, pose: VehiclePose) -> Any:
        reported_s = self._report_s if self.frozen and self.frozen_clock else t_s
        boot_ms = int((reported_s + self.boot_s) * 1e3) % 2**32
        mav = self._mav
        if number == mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED:
            if self._t - self._accepted_s > 0.5:
                return None  # only accepted setpoints are echoed
            return mav.position_target_local_ned_encode(boot_ms, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
        if number in (mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT, mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS):
            lost = self._t > min(self.ekf_failed_s, self.gps_lost_s + _EKF_NOTICED_S)
            flags = _CONSTANT_POSITION if lost else _HEALTHY
            if number == mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
                return mav.ekf_status_report_encode(flags, 0.1, 0.1, 0.1, 0.1, 0)
            return mav.estimator_status_encode(boot_ms * 1000, flags, 0.1, 0.1, 0.1, 0.1, 0, 0, 0.3, 0.3)
        if number == mavlink.MAVLINK_MSG_ID_SYS_STATUS:
            return mav.sys_status_encode(0, 0, 0, 200, 15800, 1200, self.battery, 0, 0, 0, 0, 0, 0)
        if number == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            return mav.extended_sys_state_encode(0, self.landed_state)
        if number == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
            fix = 1 if self._t > self.gps_lost_s + _GPS_NOTICED_S else 3
            return mav.gps_raw_int_encode(boot_ms * 1000, fix, 473977420, 85455940, 488000, 60, 90, 0, 0, 17)
        return super()._telemetry(number, reported_s, pose)

    def _heartbeat(self) -> Any:
        px4 = self.autopilot == "px4"
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        return self._mav.heartbeat_encode(
            mavlink.MAV_TYPE_QUADROTOR,
            mavlink.MAV_AUTOPILOT_PX4 if px4 else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | armed,
            _MODES[self.autopilot][self.mode],
            mavlink.MAV_STATE_ACTIVE,
        )


def _level(yaw: float, pitch: float) -> np.ndarray:
    """(4,) x y z w FLU -> ENU, no roll; pitch up positive."""
    # Pitch up is negative about FLU y.
    cy, sy, cp, sp = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), -math.sin(pitch / 2)
    return np.array([-sy * sp, cy * sp, sy * cp, cy * cp])
