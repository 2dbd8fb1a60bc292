"""Dynamics of the simulated copter's body: thrust that follows with a lag, drag in wind with gusts, yaw.

An autopilot's control (:mod:`drocap_ros.simulation.vehicle.flight_control`) commands acceleration and yaw rate.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.autopilot.simulated import Airframe, ReportErrors

_STEP_S = 0.1  # of the fitted processes; between their steps the errors are interpolated
_SETTLED = 600  # steps from zero: several times the longest correlation, 13 s
_DEAD_RECKONING_M_S = np.array([0.15, 0.075, 0.0])  # drift without satellites


class EstimateError:
    """Error of the estimated position and velocity, ENU, stepped in time; ``share`` of the recorded size, 0 = none.

    ``glitch`` may be changed: (3,) m that the autopilot accepted, and keeps.
    """

    def __init__(self, horizontal: ReportErrors, vertical: ReportErrors, share: float, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 0xC0])
        self.glitch: np.ndarray = np.zeros(3)
        axes = (horizontal, horizontal, vertical)
        self._first, self._second = (np.array(rows) for rows in zip(*((a.first, a.second) for a in axes), strict=True))
        self._noise = share * np.array([axis.noise for axis in axes])
        self._correlation = np.array([axis.correlation for axis in axes])
        self._now, self._before = np.zeros((3, 2)), np.zeros((3, 2))
        self._part = 0.0
        for _ in range(_SETTLED):
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

    def _advance(self) -> None:
        """One step of the processes, by sums in a fixed order: the same bits wherever the arrays lie in memory."""
        (one, other), now, before = self._rng.standard_normal((2, 3)), self._now, self._before
        noise = np.stack([one, self._correlation * one + np.sqrt(1.0 - self._correlation**2) * other], axis=1)
        after = self._first[:, :, 0] * now[:, :1] + self._first[:, :, 1] * now[:, 1:]
        after = after + self._second[:, :, 0] * before[:, :1] + self._second[:, :, 1] * before[:, 1:]
        self._now, self._before = after + self._noise * noise, now


_YAW_LAG_S = 0.1  # this and the next three: fitted to recorded orbits in 0 and 8 m/s of wind
_MAX_YAW_RATE = 1.6  # rad/s
_GUST = 0.09  # share of the wind
_GUST_AXES = np.array([1.0, 1.0, 0.2])  # it blows along the ground
_GUST_TURN = 0.27  # rad/s of yaw per m/s of lateral gust


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
        rate += _GUST_TURN * (self._gust[1] * math.cos(self.yaw) - self._gust[0] * math.sin(self.yaw))
        self.yaw_rate += (rate - self.yaw_rate) * (1 - math.exp(-dt / _YAW_LAG_S))
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
