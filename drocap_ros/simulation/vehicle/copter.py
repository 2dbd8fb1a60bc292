"""A simulated copter under setpoints, modes, time-outs, refusals and failsafes of an autopilot.

It behaves as the real ones were measured in their own simulators.  The copter
reports its estimate: the truth with the errors of GPS and attitude.
"""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.flight.vehicle import ned_to_enu
from drocap_ros.simulation.vehicle.copter_reports import EKF_NOTICED_S, CopterSetup, ReportingCopter
from drocap_ros.simulation.vehicle.flight_control import Target, manner_of

_STEP_S = 0.01  # of the body and the loops
_SETUP = CopterSetup()
#: m/s, up; of modes that change the height by themselves.
_CLIMB_M_S = {"RTL": 0.5, "LAND": -0.5}
_LOST = "failsafe: setpoints lost"


class SimulatedCopter(ReportingCopter):
    """A MAVLink vehicle with the dynamics of a copter.

    position, yaw : of the initial hover, ENU, truth
    """

    def __init__(self, transport: Transport, position: np.ndarray, yaw: float, setup: CopterSetup = _SETUP) -> None:
        super().__init__(transport, position, yaw, setup)
        self.timeout_s = setup.timeout_s
        self.settings[self.kind.timeout_setting] = setup.timeout_s
        self.denied_modes: frozenset[str] = frozenset()
        self.crashed = ""
        self.accepted_setpoints = 0
        self.deaf = False  # ignores setpoints silently
        self.sticks = True  # whether there is a remote control
        self.motion_until_s = -1.0  # last motion by setpoints
        self.fence_m = math.inf
        self.mode_log: list[tuple[float, str, str]] = [(0.0, self.mode, "start")]
        self._accepted_s = -1e9  # last accepted setpoint
        self._setpoint_s = -1e9  # last setpoint, accepted or not
        self._answers: list[tuple[float, mavlink.MAVLink_message]] = []
        self._loss_delay_s = float(np.random.default_rng([setup.seed, 0xC2]).uniform(*self.simulated.loss_check_s))
        self.control.begin(manner_of(self.kind, self.mode), self.estimate, self.body.velocity, yaw)

    @property
    def target(self) -> Target:
        """What the autopilot follows, in its estimated frame."""
        return self.control.target

    def fly(self, t_s: float) -> None:
        """Fly up to path time ``t_s``, then answer what had arrived before, and send."""
        # An answer to TIMESYNC must not be stamped before its question came: a busy machine takes its time to fly.
        data = self._transport.read(0.0)
        while self._t < t_s - 1e-9 and not self.crashed:
            dt = min(_STEP_S, t_s - self._t)
            self._t += dt
            self._failsafes()
            self._move(dt)
            self.mount.step(self.body.orientation_xyzw, dt)
            self.error.step(self._t > self.gps_lost_s, dt)
        if not self.crashed:
            self.step(t_s, data)
            while self._answers and self._answers[0][0] <= t_s:
                self._send(self._answers.pop(0)[1])

    def set_mode(self, mode: str, by: str) -> None:
        """Change the mode; ``by`` ("pilot", "command", "failsafe: ...") enters the log."""
        if not by.startswith("failsafe"):
            self.intended = mode
        if mode == self.mode:
            return
        self.mode = mode
        self.mode_log.append((self._t, mode, by))
        lost = by == _LOST and self.simulated.critical_when_lost
        self.system_status = mavlink.MAV_STATE_CRITICAL if lost else mavlink.MAV_STATE_ACTIVE
        manner = manner_of(self.kind, mode)
        yaw = self.body.yaw + self.error.yaw
        self.control.begin(manner, self.estimate, self.body.velocity + self.error.velocity, yaw)
        if mode in _CLIMB_M_S:
            self.control.target.position = None
            self.control.target.velocity = np.array([0.0, 0.0, _CLIMB_M_S[mode]])
        self._accepted_s = -1e9

    def move_stick(self) -> None:
        """The pilot moves a stick: in the control mode it counts only where a setting allows it."""
        if self.simulated.override is None or self.mode != self.kind.control_mode:
            return
        setting, bit, shipped = self.simulated.override
        if int(self.settings.get(setting, shipped)) & bit:
            self.set_mode(self.simulated.stick_mode, "pilot")

    def _move(self, dt: float) -> None:
        expired = False
        if self.mode == self.kind.control_mode:
            expired = not self.simulated.lost_modes and self._t - self._accepted_s > self.timeout_s
            if math.sqrt(self.target.velocity @ self.target.velocity) > 0.05 and not expired:
                self.motion_until_s = self._t
        speed = self.body.velocity + self.error.velocity
        command = self.control.command(self.estimate, speed, expired, dt)
        self.body.step(command, self.control.yaw_rate(self.body.yaw + self.error.yaw), dt)

    def _failsafes(self) -> None:
        if self.simulated.lost_modes:
            self._watch_setpoints()
        if self._t > min(self.ekf_failed_s + 1.0, self.gps_lost_s + EKF_NOTICED_S + 1.0) and self.mode != "LAND":
            self.set_mode("LAND", "failsafe: estimator")
        if self.fence_m < math.inf and np.hypot(*self.estimate[:2]) > self.fence_m and self.mode not in ("RTL", "LAND"):
            self.set_mode("RTL", "failsafe: fence")

    def _watch_setpoints(self) -> None:
        """The control mode ends without setpoints, and returns with them: it is still the intended mode."""
        silent_s, control_mode = self._t - self._setpoint_s, self.kind.control_mode
        if self.mode == control_mode and silent_s > self.timeout_s + self._loss_delay_s:
            meaning = self.kind.loss_action
            action = 0 if meaning is None else int(self.settings.get(meaning.setting, 0))
            mode = self.simulated.lost_modes.get(action, self.kind.hold_mode)
            self.set_mode(mode if self.sticks or action > 2 else "LAND", _LOST)
        elif self.intended == control_mode and silent_s < self.timeout_s and self.mode_log[-1][2] == _LOST:
            self.set_mode(control_mode, "failsafe: setpoints returned")

    def _answer(self, message: mavlink.MAVLink_message, t_s: float) -> None:
        name = message.get_type()
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            self._take_setpoint(message)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_DO_SET_MODE:
            result = self._change_mode(int(message.param2), int(message.param3))
            if self.kind.answers_twice:  # accepted at once, then in earnest
                self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED)
                # Measured, after the first answer.
                self._answers.append((t_s + 0.04, self._acknowledgement(message, result)))
            else:
                self._acknowledge(message, result)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW:
            taken = self.mount.command(message.param1)
            self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED if taken else mavlink.MAV_RESULT_FAILED)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self.armed = message.param1 > 0.5
            self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED)
        else:
            super()._answer(message, t_s)

    def _acknowledge(self, message: mavlink.MAVLink_message, result: int) -> None:
        self._send(self._acknowledgement(message, result))

    def _acknowledgement(self, message: mavlink.MAVLink_message, result: int) -> mavlink.MAVLink_message:
        sender = message.get_srcSystem(), message.get_srcComponent()
        return self._mav.command_ack_encode(message.command, result, 0, 0, *sender)

    def _change_mode(self, main: int, sub: int) -> int:
        mode = self.kind.mode_name(main << 16 | sub << 24 if self.kind.submodes else main)
        if not mode:
            return int(mavlink.MAV_RESULT_FAILED)
        waits = self.kind.warm_up_s > 0 and mode == self.kind.control_mode
        # One setpoint is enough.
        if mode in self.denied_modes or (waits and self._t - self._setpoint_s >= self.timeout_s):
            return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        self.set_mode(mode, "command")
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _take_setpoint(self, m: mavlink.MAVLink_message) -> None:
        if m.target_system not in (0, self._mav.srcSystem):
            return
        self._setpoint_s = self._t
        if self.deaf or self.mode != self.kind.control_mode:
            return
        if not all(map(math.isfinite, (m.x, m.y, m.z, m.yaw))):
            self.crashed = "a setpoint with NaN"
            return
        target = _target_of(m)
        if target is not None:
            self.control.take(target)
            self._accepted_s = self._t
            self.accepted_setpoints += 1


def _target_of(m: mavlink.MAVLink_message) -> Target | None:
    """What a SET_POSITION_TARGET_LOCAL_NED asks for; None = values or a frame that are silently ignored."""
    values = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate)
    if not all(map(math.isfinite, values)) or m.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
        return None
    vectors = [ned_to_enu(np.array(values[i : i + 3])) for i in (0, 3, 6)]
    velocity, acceleration = (
        np.zeros(3) if m.type_mask & bit else vector for vector, bit in zip(vectors[1:], (8, 64), strict=True)
    )
    yaw = None if m.type_mask & 1024 else math.remainder(math.pi / 2 - m.yaw, 2 * math.pi)
    rate = 0.0 if m.type_mask & 2048 else -m.yaw_rate
    return Target(None if m.type_mask & 1 else vectors[0], velocity, acceleration, yaw, rate)
