"""What the simulated copter reports of itself: estimates, readiness, the target that it follows, its mode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot.autopilot import Airframe, ReportErrors
from drocap_ros.flight.mavlink.transport import Transport
from drocap_ros.flight.vehicle import enu_to_ned
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_multiply
from drocap_ros.simulation.vehicle.flight_control import FlightControl, control_of
from drocap_ros.simulation.vehicle.mavlink_vehicle import ESTIMATOR_HEALTHY, Encode, SimulatedVehicle, VehiclePose
from drocap_ros.simulation.vehicle.mount import MOUNT_TYPES, SimulatedMount

_STEP_S = 0.1  # of the fitted processes; between their steps the errors are interpolated
_DEAD_RECKONING_M_S = np.array([0.15, 0.075, 0.0])  # drift without satellites


class EstimateError:
    """Error of the estimated position and velocity, ENU, stepped in time; ``share`` of the recorded size, 0 = none.

    ``glitch`` may be changed: (3,) m that the autopilot accepted, and keeps; so may ``yaw_sd``, of its heading ``yaw``.
    """

    def __init__(self, horizontal: ReportErrors, vertical: ReportErrors, share: float, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 0xC0])
        self.glitch: np.ndarray = np.zeros(3)
        self.yaw = self.yaw_sd = 0.0  # rad
        self._yaw_rng = np.random.default_rng([seed, 0xC3])
        axes = (horizontal, horizontal, vertical)
        self._first, self._second = (np.array(rows) for rows in zip(*((a.first, a.second) for a in axes), strict=True))
        self._noise = share * np.array([axis.noise for axis in axes])
        self._correlation = np.array([axis.correlation for axis in axes])
        self._now, self._before = np.zeros((3, 2)), np.zeros((3, 2))
        self._part = 0.0
        # From zero it takes several times the longest correlation, 13 s.
        for _ in range(600):
            self._advance()
        self._between: np.ndarray = self._before  # (3, 2) of position and velocity per axis, now

    @property
    def position(self) -> np.ndarray:
        """(3,) m, estimate less truth."""
        error: np.ndarray = self._between[:, 0] + self.glitch
        return error

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s, estimate less truth."""
        return self._between[:, 1]

    def step(self, dead_reckoning: bool, dt: float) -> None:
        """Advance by ``dt`` seconds; without satellites it drifts away."""
        self._part += dt / _STEP_S
        while self._part >= 1.0:
            self._part -= 1.0
            self._advance()
        self._between = (1.0 - self._part) * self._before + self._part * self._now
        if dead_reckoning:
            self.glitch = self.glitch + _DEAD_RECKONING_M_S * dt
        # It wanders within 10 to 60 s: recorded.
        share = math.exp(-dt / 20.0)
        push = float(self._yaw_rng.standard_normal()) if self.yaw_sd else 0.0
        self.yaw = share * self.yaw + self.yaw_sd * math.sqrt(1.0 - share**2) * push

    def _advance(self) -> None:
        """One step of the processes, by sums in a fixed order: the same bits wherever the arrays lie in memory."""
        (one, other), now, before = self._rng.standard_normal((2, 3)), self._now, self._before
        noise = np.stack([one, self._correlation * one + np.sqrt(1.0 - self._correlation**2) * other], axis=1)
        after = self._first[:, :, 0] * now[:, :1] + self._first[:, :, 1] * now[:, 1:]
        after = after + self._second[:, :, 0] * before[:, :1] + self._second[:, :, 1] * before[:, 1:]
        self._now, self._before = after + self._noise * noise, now


_MAX_YAW_RATE = 1.6  # rad/s; this and the next fitted to the same orbits as the lag of yaw
_GUST = 0.09  # share of the wind
_GUST_AXES = np.array([1.0, 1.0, 0.2])  # it blows along the ground


class Body:
    """State of the vehicle, ENU, stepped in time.

    wind : (3,) m/s mean; gusts about it
    gust : their standard deviation, a share of the wind
    """

    def __init__(
        self, position: np.ndarray, yaw: float, wind: np.ndarray, airframe: Airframe, seed: int = 0, gust: float = _GUST
    ) -> None:
        self.position: np.ndarray = position.astype(float)
        self.velocity: np.ndarray = np.zeros(3)
        self.acceleration: np.ndarray = np.zeros(3)
        self.yaw, self.yaw_rate = yaw, 0.0
        self.wind: np.ndarray = wind.astype(float)
        self._airframe = airframe
        self._gustiness = gust
        self._gust: np.ndarray = np.zeros(3)
        self._rng = np.random.default_rng([seed, 0xF1])
        # In hover the thrust already leans into the wind.
        self.thrust: np.ndarray = -self.drag()
        self._wanted: np.ndarray = self.thrust.copy()

    def step(self, command: np.ndarray, yaw_rate: float, dt: float) -> None:
        """Fly for ``dt`` seconds: (3,) m/s^2 of thrust beyond the weight, rad/s."""
        first, second = self._airframe.lags_s
        self._wanted = self._wanted + (command - self._wanted) * (1 - math.exp(-dt / second))
        self.thrust = self.thrust + (self._wanted - self.thrust) * (1 - math.exp(-dt / first))
        wind = math.sqrt(self.wind @ self.wind)
        if wind > 0:
            decay = math.exp(-dt / 1.5)
            strength = self._gustiness * wind * math.sqrt(1 - decay**2)
            self._gust = decay * self._gust + strength * self._rng.standard_normal(3) * _GUST_AXES
        self.acceleration = self.thrust + self.drag()
        self.position = self.position + self.velocity * dt + 0.5 * self.acceleration * dt * dt
        self.velocity = self.velocity + self.acceleration * dt
        rate = min(max(yaw_rate, -_MAX_YAW_RATE), _MAX_YAW_RATE)
        # Lag of yaw, and rad/s of yaw per m/s of lateral gust, fitted to recorded orbits in 0 and 8 m/s of wind.
        rate += 0.27 * (self._gust[1] * math.cos(self.yaw) - self._gust[0] * math.sin(self.yaw))
        self.yaw_rate += (rate - self.yaw_rate) * (1 - math.exp(-dt / 0.1))
        self.yaw = math.remainder(self.yaw + self.yaw_rate * dt, 2 * math.pi)

    def drag(self) -> np.ndarray:
        """(3,) m/s^2 by the air."""
        friction = self._airframe.friction
        relative = self.wind + self._gust
        if not friction:
            relative = relative - self.velocity
        drag: np.ndarray = (self._airframe.inflow + self._airframe.drag * math.sqrt(relative @ relative)) * relative
        return drag - friction * self.velocity

    def orientation_xyzw(self) -> np.ndarray:
        """(4,) body FLU -> ENU: the thrust tilts the body, also against the wind."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        ahead = self.thrust[0] * c + self.thrust[1] * s
        left = -self.thrust[0] * s + self.thrust[1] * c
        pitch, roll = 0.5 * math.atan2(ahead, 9.81), -0.5 * math.atan2(left, 9.81)
        half = 0.5 * self.yaw
        (cr, cp, cy), (sr, sp, sy) = (
            (math.cos(roll), math.cos(pitch), math.cos(half)), (math.sin(roll), math.sin(pitch), math.sin(half)),
        )  # fmt: skip
        return np.array([
            sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy,
        ])  # fmt: skip


EKF_NOTICED_S = 7.4  # from the loss of satellites to the estimator's report: measured
_GYRO = np.array([math.radians(0.3), 0.01, math.radians(0.6)])  # offset, scale and noise, rad/s: assumed
_CONSTANT_POSITION = ESTIMATOR_HEALTHY & ~(8 | 16) | 128
_NO_POSITION = 1 | 2 | 4  # POSITION_TARGET_TYPEMASK
_NO_YAW = 1024 | 2048  # POSITION_TARGET_TYPEMASK: neither yaw nor its rate
_PLACES = {mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT}


class CopterSetup(NamedTuple):
    """Of a simulated copter.

    wind : (3,) m/s
    estimate_error : of the estimate, as a share of the recorded ones
    yaw_error_deg : standard deviation of the heading's error, which wanders within 20 s; PX4's was 4 to 19 at worst
    gyro_error : of the rate of yaw, as a share of 0.3 deg/s, 1 % and a noise of 0.6 deg/s
    timeout_s : its own time-out without setpoints
    mode : at first; "" = that of the sticks
    mount : of the camera; None = a gimbal, level
    ready_s : path times, s, from which there is a satellite fix, a healthy estimator, and an origin of the local frame
    """

    autopilot: str = "ardupilot"
    wind: Sequence[float] = (0.0, 0.0, 0.0)
    seed: int = 0
    estimate_error: float = 1.0
    attitude_error_deg: float = 0.4
    yaw_error_deg: float = 0.0
    gyro_error: float = 1.0
    timeout_s: float = 0.5
    mode: str = "LOITER"
    mount: SimulatedMount | None = None
    ready_s: tuple[float, float, float] = (-1.0, -1.0, -1.0)


class ReportingCopter(SimulatedVehicle):
    """State of a copter and its telemetry; see :class:`drocap_ros.simulation.vehicle.copter.SimulatedCopter`."""

    def __init__(self, transport: Transport, position: np.ndarray, yaw: float, setup: CopterSetup) -> None:
        self.mount = setup.mount or SimulatedMount()
        self._fix_s, self._estimator_s, self._origin_s = setup.ready_s
        super().__init__(transport, setup.autopilot, gimbal=self.mount.kind != "fixed")
        if self.kind.mount_type_setting:
            self.settings[self.kind.mount_type_setting] = float(MOUNT_TYPES[self.mount.kind])
        self.body = Body(position, yaw, np.array(setup.wind, float), self.simulated.airframe, setup.seed)
        self.control: FlightControl = control_of(self.kind, position, yaw, self.body.drag())
        self.error = EstimateError(self.simulated.horizontal, self.simulated.vertical, setup.estimate_error, setup.seed)
        self.mode = self.intended = setup.mode or self.simulated.stick_mode
        self.gps_lost_s = self.ekf_failed_s = math.inf
        self.frozen = False  # telemetry repeats its last values, with fresh or old stamps
        self.frozen_clock = False
        self._t = 0.0
        self._rng = np.random.default_rng([setup.seed, 0xC1])
        self._attitude_error = math.radians(setup.attitude_error_deg) * self._rng.standard_normal(3)
        # The estimate of the body leans wrongly by as much as that of a gimbal.
        lean = np.array([*(0.5 * self._attitude_error[:2]), 0.0, 1.0])
        self._lean_error = lean / np.linalg.norm(lean)
        self.error.yaw_sd = math.radians(setup.yaw_error_deg)
        self._gyro_rng = np.random.default_rng([setup.seed, 0xC4])
        self._gyro_sd = setup.gyro_error * _GYRO
        self._gyro_error = self._gyro_sd * self._gyro_rng.standard_normal(3)
        self._report: VehiclePose | None = None
        self._report_s = -1.0

    @property
    def gps_error(self) -> np.ndarray:
        """(3,) m, estimate less truth; setting it moves the estimate."""
        return self.error.position

    @gps_error.setter
    def gps_error(self, value: np.ndarray) -> None:
        shift = value - self.error.position
        self.error.glitch = self.error.glitch + shift
        self.control.reset_estimate(shift)

    @property
    def estimate(self) -> np.ndarray:
        """(3,) m, the autopilot's position estimate."""
        estimate: np.ndarray = self.body.position + self.error.position
        return estimate

    def at(self, t_s: float) -> VehiclePose:
        """Reported pose: the estimate, not the truth."""
        if self._report is not None and (self.frozen or t_s == self._report_s):
            return self._report
        self._report_s = t_s
        body = self.body.orientation_xyzw()
        offset, scale, _ = self._gyro_error
        rate = self.body.yaw_rate * (1.0 + scale) + offset + self._gyro_sd[2] * self._gyro_rng.standard_normal()
        turn = np.array([0.0, 0.0, math.sin(0.5 * self.error.yaw), math.cos(0.5 * self.error.yaw)])
        reported = quaternion_multiply(quaternion_multiply(turn, body), self._lean_error)
        self._report = VehiclePose(
            self.estimate,
            self.body.velocity + self.error.velocity,
            reported,
            rate * matrix_from_quaternion(reported)[2],  # about the vertical alone
            self.mount.camera(body),
        )
        return self._report

    def camera_orientation(self) -> np.ndarray:
        """(4,) camera FLU -> ENU, truth."""
        return self.mount.camera(self.body.orientation_xyzw())

    def _known(self) -> frozenset[int]:
        own = {mavlink.MAVLINK_MSG_ID_HEARTBEAT} if self.kind.heartbeat_on_request else set()
        return super()._known() | own

    def _all_encoders(self) -> dict[int, Encode]:
        return super()._all_encoders() | {mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: self._echo}

    def _telemetry(self, number: int, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message | None:
        if number in _PLACES and self._t < self._origin_s:
            return None
        return super()._telemetry(number, self._report_s if self.frozen and self.frozen_clock else t_s, pose)

    def _mount_angles(self, t_s: float, pose: VehiclePose) -> mavlink.MAVLink_message | None:
        _, pitch, yaw = self._attitude_error
        mounted = self.mount.report(pose.orientation_xyzw, (pitch, yaw))
        if mounted is None:
            return None
        quaternion, flags = mounted
        return self._mav.gimbal_device_attitude_status_encode(0, 0, self._boot_ms(t_s), flags, quaternion, 0, 0, 0, 0)

    def _estimator_flags(self) -> int:
        lost = self._t > min(self.ekf_failed_s, self.gps_lost_s + EKF_NOTICED_S)
        blind = lost or self._t < self._estimator_s
        return _CONSTANT_POSITION if blind else super()._estimator_flags()

    def _satellites(self, t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message:
        # From the loss of satellites to its report: measured.
        there = self._fix_s <= self._t <= self.gps_lost_s + 0.4
        fix, place = 3 if there else 1, (473977420, 85455940, 488000)
        return self._mav.gps_raw_int_encode(self._boot_ms(t_s) * 1000, fix, *place, 60, 90, 0, 0, 17)

    def _echo(self, t_s: float, _pose: VehiclePose) -> mavlink.MAVLink_message | None:
        """The target that is followed, whether setpoints arrive or not.

        A setpoint that is continued is sent throughout the control mode; of one that is held, what the controller
        commands is sent in every mode: the velocity with the correction of the position.
        """
        target, control = self.control.target, self.control
        mask, velocity, acceleration, yaw = 0, target.velocity, target.acceleration, 0.0
        if self.kind.continues_setpoints:
            if self.mode != self.kind.control_mode:
                return None
            mask = _NO_YAW
            position = np.zeros(3) if target.position is None else target.position
            mask |= _NO_POSITION if target.position is None else 0
        else:
            position = np.full(3, math.nan)
            if control.place is not None and target.position is not None:
                position = np.array([*control.place, target.position[2]])
            velocity, acceleration = control.commanded_velocity, np.array([*control.push, 0.0])
            yaw = math.nan if target.yaw is None else math.remainder(math.pi / 2 - target.yaw, 2 * math.pi)
        values = [float(v) for vector in (position, velocity, acceleration) for v in enu_to_ned(vector)]
        return self._mav.position_target_local_ned_encode(
            self._boot_ms(t_s), mavlink.MAV_FRAME_LOCAL_NED, mask, *values, yaw, -target.yaw_rate
        )
