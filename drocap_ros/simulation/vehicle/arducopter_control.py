"""ArduPilot Copter's way to follow setpoints and to stop.

A setpoint of position, velocity and acceleration is not held but continued: velocity grows by the acceleration, the
position by both, until GUID_TIMEOUT.  Then velocity and acceleration become zero and the place that was reached is the
target.  A copy of the target, limited in acceleration and jerk, is what the loops follow: it overshoots and springs
back.  Path and loops are those of AC_PosControl with the parameters that Copter ships with; LOITER and the airframe's
drag were fitted to the recorded flights of its simulation.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.simulation.vehicle.flight_control import (
    MAX_LEAN_M_S2,
    FlightControl,
    Gains,
    Manner,
    Target,
    filter_share,
    limited,
    rooted,
)

#: PSC_NE_POS_P, PSC_NE_VEL_P, _I and _D.
_GAINS = Gains(position=1.0, velocity=2.0, integral=1.0, derivative=0.25)
#: WP_SPD, WP_ACC and PSC_JERK_NE.  Jerk over acceleration is the path's gain for the velocity, half of it that for the
#: place, which is approached with half of the acceleration.
_MAX_M_S, _MAX_M_S2, _JERK_M_S3 = 10.0, 2.5, 5.0
_PACE_GAIN, _PLACE_GAIN, _PLACE_M_S2 = 2.0, 1.0, 1.25
#: Decay of the velocity, 1/s: in BRAKE its jerk limit over its deceleration, in LOITER of released sticks.
_BRAKE_GAIN, _LOITER_GAIN, _LOITER_M_S2, _STICK_GAIN, _STICK_M_S2 = 0.667, 1.28, 2.92, 3.0, 2.5


class ArduCopterControl(FlightControl):
    """Loops of ArduPilot Copter."""

    def __init__(self, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        super().__init__(_GAINS, position, yaw, drag)
        self._filtered = (0.0, 0.0)

    def begin(self, manner: Manner, position: np.ndarray, velocity: np.ndarray, yaw: float) -> None:
        """Enter a mode; GUIDED starts with a stop."""
        if self.manner != Manner.SETPOINTS:
            self.push = [0.0, 0.0]
        super().begin(manner, position, velocity, yaw)
        if manner == Manner.SETPOINTS:
            stop_m = rooted(float(velocity[0]), float(velocity[1]), 1.0, _MAX_M_S2)
            assert self.target.position is not None
            self.target.position[:2] += stop_m

    def take(self, target: Target) -> None:
        """Take a setpoint."""
        if (target.position is None) != (self.target.position is None):
            self.place = None if target.position is None else self.place
        super().take(target)

    def reset_estimate(self, shift: np.ndarray) -> None:
        """The path moves with a reset of the estimate, as by AC_PosControl; the setpoint that was sent stays."""
        if self.place is not None:
            self.place = [self.place[i] + float(shift[i]) for i in (0, 1)]

    def _sensed(
        self, error: tuple[float, float], speed: tuple[float, float], dt: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        share, (x, y) = filter_share(dt), self._filtered
        self._filtered = x + (error[0] - x) * share, y + (error[1] - y) * share
        return self._filtered, self._filtered

    def _leaning(self, x: float, y: float) -> tuple[float, float]:
        """What turns the path comes before what follows it."""
        pace = math.hypot(*self.pace)
        if math.hypot(x, y) <= MAX_LEAN_M_S2 or pace < 1e-6:
            return limited(x, y, MAX_LEAN_M_S2)
        ahead = self.pace[0] / pace, self.pace[1] / pace
        along = x * ahead[0] + y * ahead[1]
        across = limited(x - along * ahead[0], y - along * ahead[1], MAX_LEAN_M_S2)
        left = math.sqrt(max(MAX_LEAN_M_S2**2 - across[0] ** 2 - across[1] ** 2, 0.0))
        along = min(max(along, -left), left)
        return across[0] + along * ahead[0], across[1] + along * ahead[1]

    def _shape(self, here: tuple[float, float], speed: tuple[float, float], expired: bool, dt: float) -> None:
        if self.manner == Manner.BRAKE:
            self._stop_pace(_BRAKE_GAIN, 7.5, _JERK_M_S3, dt)
        elif self.manner == Manner.HOLD:
            self._stop_pace(_LOITER_GAIN, _LOITER_M_S2, _JERK_M_S3, dt)
        elif self.manner == Manner.STICK:
            stick = self.target.velocity
            gap = float(stick[0]) - self.pace[0], float(stick[1]) - self.pace[1]
            self._advance(limited(_STICK_GAIN * gap[0], _STICK_GAIN * gap[1], _STICK_M_S2), _JERK_M_S3, dt)
        else:
            self._follow(here, expired, dt)

    def _follow(self, here: tuple[float, float], expired: bool, dt: float) -> None:
        target = self.target
        if expired:
            target.velocity, target.acceleration, target.yaw_rate = np.zeros(3), np.zeros(3), 0.0
        ahead = float(target.velocity[0]) - self.pace[0], float(target.velocity[1]) - self.pace[1]
        if self.place is None:
            self.place = list(here)
        if target.position is not None:
            x, y = (float(target.position[i]) - self.place[i] for i in (0, 1))
            closing = limited(*rooted(x, y, _PLACE_GAIN, _PLACE_M_S2), _MAX_M_S)
            ahead = ahead[0] + closing[0], ahead[1] + closing[1]
        ahead = limited(*rooted(*ahead, _PACE_GAIN, _JERK_M_S3), _MAX_M_S2)
        forward = float(target.acceleration[0]), float(target.acceleration[1])
        self._advance((ahead[0] + forward[0], ahead[1] + forward[1]), _JERK_M_S3, dt)
        if target.position is not None:
            target.position = target.position + target.velocity * dt + 0.5 * target.acceleration * dt * dt
        target.velocity = target.velocity + target.acceleration * dt
