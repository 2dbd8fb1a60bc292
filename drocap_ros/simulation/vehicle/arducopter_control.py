"""ArduPilot Copter's way to follow setpoints and to stop, fitted to the recorded flights of its own simulation.

A setpoint of position, velocity and acceleration is not held but continued: velocity grows by the acceleration, the
position by both, until GUID_TIMEOUT.  Then velocity and acceleration become zero and the place that was reached is the
target.  A smoothed copy of the target, limited in acceleration and jerk, is what the loops follow: it overshoots and
springs back.  Gains and limits were fitted together with the airframe's drag, calm and in 8 m/s of wind.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.simulation.vehicle.flight_control import FlightControl, Gains, Manner, Target, limited, rooted

_GAINS = Gains(position=1.0, velocity=4.44, integral=0.742, derivative=0.271, feed=0.53)
_MAX_M_S2, _JERK_M_S3, _MAX_M_S = 2.8, 5.68, 9.2
_PLACE_GAIN, _PACE_GAIN, _PLACE_M_S2 = 1.43, 1.78, 0.835
#: Decay of the velocity, 1/s: in BRAKE its jerk limit over its deceleration, in LOITER of released sticks.
_BRAKE_GAIN, _LOITER_GAIN, _LOITER_M_S2, _STICK_GAIN, _STICK_M_S2 = 0.688, 1.28, 2.92, 3.0, 2.5


class ArduCopterControl(FlightControl):
    """Loops of ArduPilot Copter."""

    def __init__(self, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        super().__init__(_GAINS, position, yaw, drag)

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
        wanted = [float(target.velocity[i]) - self.pace[i] for i in (0, 1)]
        if target.position is not None:
            if self.place is None:
                self.place = list(here)
            x, y = (float(target.position[i]) - self.place[i] for i in (0, 1))
            correction = self._correction(x, y, (-wanted[0], -wanted[1]))
            wanted = [wanted[0] + correction[0], wanted[1] + correction[1]]
        ahead = cornering(_PACE_GAIN * wanted[0], _PACE_GAIN * wanted[1], (self.pace[0], self.pace[1]), _MAX_M_S2)
        forward = float(target.acceleration[0]), float(target.acceleration[1])
        self._advance((ahead[0] + forward[0], ahead[1] + forward[1]), _JERK_M_S3, dt)
        if target.position is not None:
            target.position = target.position + target.velocity * dt + 0.5 * target.acceleration * dt * dt
        target.velocity = target.velocity + target.acceleration * dt

    def _correction(self, x: float, y: float, ahead: tuple[float, float]) -> tuple[float, float]:
        """(2,) m/s towards the target from its offset (m) and the own velocity beyond the target's.

        The faster the target is approached, the sooner the correction is taken back.
        """
        error = math.hypot(x, y)
        if error < 1e-9:
            return 0.0, 0.0
        rate = math.hypot(*rooted(x, y, _PLACE_GAIN, _PLACE_M_S2))
        closing = (ahead[0] * x + ahead[1] * y) / error
        if closing > 0:
            rate -= closing * min(1.0, _PLACE_M_S2 / (rate * _PLACE_GAIN))
        rate = min(max(rate, -_MAX_M_S), _MAX_M_S) / error
        return x * rate, y * rate


def cornering(x: float, y: float, velocity: tuple[float, float], most: float) -> tuple[float, float]:
    """The acceleration, no longer than ``most``: braking comes first, then the turn, then speeding up."""
    speed = math.hypot(*velocity)
    if speed < 1e-6:
        return limited(x, y, most)
    x, y = limited(x, y, 2 * most)
    ahead = velocity[0] / speed, velocity[1] / speed
    along = x * ahead[0] + y * ahead[1]
    across = x - along * ahead[0], y - along * ahead[1]
    if along > 0:
        across = limited(*across, most)
        along = min(along, math.sqrt(max(most**2 - across[0] ** 2 - across[1] ** 2, 0.0)))
    else:
        along = max(along, -most)
        across = limited(*across, math.sqrt(max(most**2 - along**2, 0.0)))
    return across[0] + along * ahead[0], across[1] + along * ahead[1]
