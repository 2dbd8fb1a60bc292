"""The setpoint: commanded motion of the vehicle at one instant."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Setpoint(NamedTuple):
    """Position (3,) m, velocity (3,) m/s and acceleration (3,) m/s^2 in ENU; yaw rad from east, yaw rate rad/s."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    yaw: float
    yaw_rate: float

    def is_finite(self) -> bool:
        """Whether it may be sent: NaN as position or yaw has crashed an autopilot."""
        vectors = np.isfinite(self.position).all() and np.isfinite(self.velocity).all()
        return bool(vectors and np.isfinite(self.acceleration).all() and np.isfinite([self.yaw, self.yaw_rate]).all())


def hold_setpoint(position: np.ndarray, yaw: float) -> Setpoint:
    """Setpoint that stays at a position."""
    return Setpoint(position.copy(), np.zeros(3), np.zeros(3), yaw, 0.0)
