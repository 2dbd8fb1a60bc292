"""Dynamics of the simulated copter: a point mass with lag under an autopilot's position and velocity loops, in wind.

The loops are tuned to measurements on ArduPilot Copter: stops from 2 m/s, errors of an orbit of 6 m at 2 m/s for each
content of the setpoint, in wind and about a moving centre.  ``test/simulation/vehicle/test_copter_measured.py`` prints
both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

_POSITION_GAIN, _VELOCITY_GAIN, _INTEGRAL_GAIN = 0.9, 1.55, 0.06
_LAG_S = 0.12
_FEED_FORWARD = 0.77  # share of the commanded acceleration that passes the autopilot's shaping
_SHAPING_M_S2 = 4.1  # largest change of the wanted velocity beyond the feed forward
_MAX_ACCELERATION, _MAX_SPEED, _MAX_CLIMB = 4.5, 9.7, 2.5
_YAW_GAIN, _YAW_LAG_S, _MAX_YAW_RATE = 6.85, 0.1, 1.6
_DRAG = 0.016
_GUST = 0.12  # share of the wind
_GUST_TURN = 0.24  # rad/s of yaw per m/s of lateral gust


@dataclass
class Target:
    """Input of the loops, ENU; None = not commanded."""

    position: np.ndarray | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(3))
    yaw: float | None = None
    yaw_rate: float = 0.0


class PointMass:
    """State of the vehicle, ENU, stepped in time.

    wind : (3,) m/s mean; gusts about it
    """

    def __init__(self, position: np.ndarray, yaw: float, wind: np.ndarray, seed: int = 0) -> None:
        self.position: np.ndarray = position.astype(float)
        self.velocity: np.ndarray = np.zeros(3)
        self.acceleration: np.ndarray = np.zeros(3)
        self.yaw, self.yaw_rate = yaw, 0.0
        self._thrust: np.ndarray = np.zeros(3)
        self._shaped: np.ndarray = np.zeros(3)
        self._wind: np.ndarray = wind.astype(float)
        self._gust: np.ndarray = np.zeros(3)
        self._rng = np.random.default_rng([seed, 0xF1])
        # In hover the integral has already adapted to the wind.
        self._integral: np.ndarray = -self._drag()

    def step(self, target: Target, dt: float) -> None:
        """Fly for ``dt`` seconds."""
        error = np.zeros(3) if target.position is None else target.position - self.position
        wanted = target.velocity + _POSITION_GAIN * error
        speed = math.hypot(wanted[0], wanted[1])
        if speed > _MAX_SPEED:
            wanted[:2] *= _MAX_SPEED / speed
        wanted[2] = min(max(wanted[2], -_MAX_CLIMB), _MAX_CLIMB)
        change = wanted - self._shaped
        room = (_SHAPING_M_S2 + float(np.linalg.norm(target.acceleration))) * dt
        size = float(np.linalg.norm(change))
        self._shaped = wanted.copy() if size <= room else self._shaped + change * (room / size)
        gap = self._shaped - self.velocity
        self._integral = np.clip(self._integral + _INTEGRAL_GAIN * gap * dt, -3, 3)
        command = _FEED_FORWARD * target.acceleration + _VELOCITY_GAIN * gap + self._integral
        size = float(np.linalg.norm(command))
        if size > _MAX_ACCELERATION:
            command *= _MAX_ACCELERATION / size
        self._thrust += (command - self._thrust) * (1 - math.exp(-dt / _LAG_S))
        decay = math.exp(-dt / 1.5)
        strength = _GUST * float(np.linalg.norm(self._wind)) * math.sqrt(1 - decay**2)
        self._gust = decay * self._gust + strength * self._rng.standard_normal(3) * np.array([1, 1, 0.2])
        self.acceleration = self._thrust + self._drag()
        self.position = self.position + self.velocity * dt + 0.5 * self.acceleration * dt * dt
        self.velocity = self.velocity + self.acceleration * dt
        rate = target.yaw_rate
        if target.yaw is not None:
            rate += _YAW_GAIN * math.remainder(target.yaw - self.yaw, 2 * math.pi)
        rate = min(max(rate, -_MAX_YAW_RATE), _MAX_YAW_RATE)
        rate += _GUST_TURN * (self._gust[1] * math.cos(self.yaw) - self._gust[0] * math.sin(self.yaw))
        self.yaw_rate += (rate - self.yaw_rate) * (1 - math.exp(-dt / _YAW_LAG_S))
        self.yaw = math.remainder(self.yaw + self.yaw_rate * dt, 2 * math.pi)

    def orientation_xyzw(self) -> np.ndarray:
        """(4,) body FLU -> ENU: the thrust tilts the body."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        ahead = self._thrust[0] * c + self._thrust[1] * s
        left = -self._thrust[0] * s + self._thrust[1] * c
        pitch, roll = 0.5 * math.atan2(ahead, 9.81), -0.5 * math.atan2(left, 9.81)
        half = 0.5 * self.yaw
        (cr, cp, cy), (sr, sp, sy) = (
            (math.cos(roll), math.cos(pitch), math.cos(half)), (math.sin(roll), math.sin(pitch), math.sin(half)),
        )  # fmt: skip
        return np.array([
            sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy,
        ])  # fmt: skip

    def _drag(self) -> np.ndarray:
        relative = self._wind + self._gust - self.velocity
        drag: np.ndarray = _DRAG * float(np.linalg.norm(relative)) * relative
        return drag
