"""Acceleration that a vehicle behind a walking subject lacks: wind and friction slow it down.

The integral of an autopilot's velocity loop adapts within several seconds, a walking subject turns sooner.  Where the
acceleration of a setpoint is passed on to the thrust, it ends with the setpoints.  An autopilot that continues its path
by it does so after the last setpoint too, and gets none.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.observed import Observed
from drocap_ros.flight.setpoint import Setpoint

_RATE, _FORGETTING = 0.8, 0.1  # 1/s^2 of the missing velocity; 1/s
_STANDING_M_S, _SHARE, _GREATEST_M_S2 = 0.3, 0.6, 0.6  # m/s, 1/s of the subject's speed beyond: standing needs none


class Shortfall:
    """Integral of the commanded velocity that the vehicle does not reach; it reads no clock."""

    def __init__(self) -> None:
        self._integral: np.ndarray = np.zeros(2)  # m/s^2 ENU

    def added(self, setpoint: Setpoint, seen: Observed, subject_velocity: np.ndarray) -> Setpoint:
        """The setpoint with the missing acceleration along the line of sight.

        subject_velocity : (2,) m/s, smoothed
        """
        subject = seen.subject.position
        if seen.autopilot.continues_setpoints or subject is None:
            return setpoint
        sight = subject[:2] - seen.vehicle.position[:2]
        toward = sight / max(float(np.hypot(*sight)), 0.5)
        speed = float(np.hypot(*subject_velocity))
        most = min(_SHARE * max(speed - _STANDING_M_S, 0.0), _GREATEST_M_S2)
        along = min(max(float(self._integral @ toward), -most), most)
        return setpoint._replace(acceleration=setpoint.acceleration + np.append(along * toward, 0.0))

    def learn(self, sent: Setpoint, seen: Observed, dt: float) -> None:
        """Take the setpoint that was sent, ``dt`` s after the one before."""
        wanted = sent.velocity + seen.autopilot.position_gain_per_s * (sent.position - seen.vehicle.position)
        missing = (wanted - seen.vehicle.velocity)[:2]
        dt = min(max(dt, 0.0), 0.2)
        self._integral = self._integral + (_RATE * missing - _FORGETTING * self._integral) * dt
        size = math.hypot(*self._integral)
        self._integral = self._integral * min(1.0, 1.0 / max(size, 1e-9))  # m/s^2 at most
