"""A simulated copter under setpoints, modes, time-outs, refusals and failsafes of ArduPilot or PX4.

Both behave as they were measured in their own simulators; ``replay.py`` compares the recorded flights.  The copter
reports its estimate: the truth with the errors of GPS and attitude.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.frames import ned_to_enu
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.simulation.vehicle.autopilot_modes import (
    CLIMB_M_S,
    CONTROL_MODE,
    MODES,
    OFFBOARD_LOST_MODE,
    manner_of,
)
from drocap_ros.simulation.vehicle.copter_reports import EKF_NOTICED_S, Readiness, ReportingCopter
from drocap_ros.simulation.vehicle.flight_control import Target
from drocap_ros.simulation.vehicle.mount import SimulatedMount

_STEP_S = 0.01
_READY = Readiness()
#: PX4 checks for the loss of setpoints a little later than COM_OF_LOSS_T; its second answer comes after the first.
_LOSS_CHECK_S, _SECOND_ANSWER_S = (0.06, 0.13), 0.04
_STICKS_OVERRIDE_OFFBOARD = 2  # bit of COM_RC_OVERRIDE


class SimulatedCopter(ReportingCopter):
    """A MAVLink vehicle with the dynamics of a copter.

    Parameters
    ----------
    position, yaw : of the initial hover, ENU, truth
    wind : (3,) m/s
    guid_timeout_s : ArduPilot's GUID_TIMEOUT
    offboard_loss_s : PX4's COM_OF_LOSS_T; 1 s as PX4 ships
    gps_noise_m : of the slow error of the position; fine errors are added
    mount : of the camera; None = a gimbal, level
    readiness : when what the pilot waits for comes, one after the other
    """

    def __init__(
        self, transport: Transport, position: np.ndarray, yaw: float, autopilot: str = "ardupilot", *,
        wind: np.ndarray | None = None, seed: int = 0, gps_noise_m: float = 0.4, attitude_error_deg: float = 0.4,
        guid_timeout_s: float = 0.5, mode: str = "LOITER", offboard_loss_s: float = 0.5,
        mount: SimulatedMount | None = None, readiness: Readiness = _READY,
    ) -> None:  # fmt: skip
        super().__init__(
            transport, position, yaw, autopilot, np.zeros(3) if wind is None else wind, seed, gps_noise_m,
            attitude_error_deg, mode, mount or SimulatedMount(), readiness,
        )  # fmt: skip
        self.guid_timeout_s, self.offboard_loss_s = guid_timeout_s, offboard_loss_s
        timeout = {"COM_OF_LOSS_T": offboard_loss_s} if autopilot == "px4" else {"GUID_TIMEOUT": guid_timeout_s}
        self.settings.update(timeout)
        self.denied_modes: frozenset[str] = frozenset()
        self.crashed = ""
        self.accepted_setpoints = 0
        self.deaf = False  # ignores setpoints silently
        self.sticks = True  # whether there is a remote control
        self.motion_until_s = -1.0  # last motion by setpoints
        self.fence_m = math.inf
        self.mode_log: list[tuple[float, str, str]] = [(0.0, mode, "start")]
        self._accepted_s = -1e9  # last accepted setpoint
        self._setpoint_s = -1e9  # last setpoint, accepted or not
        self._answers: list[tuple[float, Any]] = []
        self._loss_delay_s = float(np.random.default_rng([seed, 0xC2]).uniform(*_LOSS_CHECK_S))
        self.control.begin(manner_of(autopilot, mode), self.estimate, self.body.velocity, yaw)

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
            self.mount.step(self.body.orientation_xyzw(), dt)
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
        manner = manner_of(self.autopilot, mode)
        self.control.begin(manner, self.estimate, self.body.velocity + self.error.velocity, self.body.yaw)
        if mode in CLIMB_M_S:
            self.control.target.position = None
            self.control.target.velocity = np.array([0.0, 0.0, CLIMB_M_S[mode]])
        if self.autopilot == "ardupilot":
            self._accepted_s = -1e9

    def move_stick(self) -> None:
        """The pilot moves a stick: in OFFBOARD it counts only where COM_RC_OVERRIDE allows it."""
        override = int(self.settings.get("COM_RC_OVERRIDE", 1)) & _STICKS_OVERRIDE_OFFBOARD
        if self.autopilot == "px4" and self.mode == "OFFBOARD" and override:
            self.set_mode("POSCTL", "pilot")

    def _move(self, dt: float) -> None:
        expired = False
        if self.mode == CONTROL_MODE[self.autopilot]:
            expired = self.autopilot == "ardupilot" and self._t - self._accepted_s > self.guid_timeout_s
            if math.sqrt(self.target.velocity @ self.target.velocity) > 0.05 and not expired:
                self.motion_until_s = self._t
        speed = self.body.velocity + self.error.velocity
        command = self.control.command(self.estimate, speed, expired, dt)
        self.body.step(command, self.control.yaw_rate(self.body.yaw), dt)

    def _failsafes(self) -> None:
        if self.autopilot == "px4":
            self._watch_offboard()
        if self._t > min(self.ekf_failed_s + 1.0, self.gps_lost_s + EKF_NOTICED_S + 1.0) and self.mode != "LAND":
            self.set_mode("LAND", "failsafe: estimator")
        if np.hypot(*self.estimate[:2]) > self.fence_m and self.mode not in ("RTL", "LAND"):
            self.set_mode("RTL", "failsafe: fence")

    def _watch_offboard(self) -> None:
        """OFFBOARD ends without setpoints, and returns with them: it is still the intended mode."""
        silent_s = self._t - self._setpoint_s
        if self.mode == "OFFBOARD" and silent_s > self.offboard_loss_s + self._loss_delay_s:
            action = int(self.settings.get("COM_OBL_RC_ACT", 0))
            mode = OFFBOARD_LOST_MODE.get(action, "LOITER")
            self.set_mode(mode if self.sticks or action > 2 else "LAND", "failsafe: offboard lost")
        elif (
            self.intended == "OFFBOARD"
            and silent_s < self.offboard_loss_s
            and self.mode_log[-1][2] == "failsafe: offboard lost"
        ):
            self.set_mode("OFFBOARD", "failsafe: offboard returned")

    def _answer(self, message: Any, t_s: float) -> None:
        name = message.get_type()
        if name == "SET_POSITION_TARGET_LOCAL_NED":
            self._take_setpoint(message)
        elif name == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_DO_SET_MODE:
            result = self._change_mode(int(message.param2), int(message.param3))
            if self.autopilot == "px4":  # accepted at once, then in earnest
                self._acknowledge(message, mavlink.MAV_RESULT_ACCEPTED)
                self._answers.append((t_s + _SECOND_ANSWER_S, self._acknowledgement(message, result)))
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

    def _acknowledge(self, message: Any, result: int) -> None:
        self._send(self._acknowledgement(message, result))

    def _acknowledgement(self, message: Any, result: int) -> Any:
        sender = message.get_srcSystem(), message.get_srcComponent()
        return self._mav.command_ack_encode(message.command, result, 0, 0, *sender)

    def _change_mode(self, main: int, sub: int) -> int:
        number = main if self.autopilot == "ardupilot" else main << 16 | sub << 24
        names = [name for name, value in MODES[self.autopilot].items() if value == number]
        if not names:
            return int(mavlink.MAV_RESULT_FAILED)
        streams = self._t - self._setpoint_s < self.offboard_loss_s  # one setpoint is enough
        if names[0] in self.denied_modes or (names[0] == "OFFBOARD" and not streams):
            return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
        self.set_mode(names[0], "command")
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _take_setpoint(self, m: Any) -> None:
        if m.target_system not in (0, self._mav.srcSystem):
            return
        values = (m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate)
        self._setpoint_s = self._t
        if self.deaf or (self.mode != CONTROL_MODE[self.autopilot] and self.autopilot == "ardupilot"):
            return
        if self.mode == CONTROL_MODE[self.autopilot] and not all(math.isfinite(v) for v in (*values[:3], m.yaw)):
            self.crashed = "a setpoint with NaN"
            return
        if not all(map(math.isfinite, values)) or m.coordinate_frame != mavlink.MAV_FRAME_LOCAL_NED:
            return
        mask = m.type_mask
        vectors = [ned_to_enu(np.array(values[i : i + 3])) for i in (0, 3, 6)]
        keep = [not mask & bit for bit in (1, 8, 64)]
        yaw = None if mask & 1024 else math.remainder(math.pi / 2 - m.yaw, 2 * math.pi)
        target = Target(
            vectors[0] if keep[0] else None, vectors[1] if keep[1] else np.zeros(3),
            vectors[2] if keep[2] else np.zeros(3), yaw, 0.0 if mask & 2048 else -m.yaw_rate,
        )  # fmt: skip
        if self.mode == CONTROL_MODE[self.autopilot]:
            self.control.take(target)
            self._accepted_s = self._t
            self.accepted_setpoints += 1
