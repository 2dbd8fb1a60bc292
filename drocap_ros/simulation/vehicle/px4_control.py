"""PX4's way to follow setpoints and to stop, fitted to the recorded flights of its SIH simulator.

A setpoint is held as it came: it does not move on with its velocity.  Its position, velocity and acceleration act
together until the mode changes.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.simulation.vehicle.flight_control import FlightControl, Gains, Manner, limited

#: PX4 as it ships.
_GAINS = Gains(position=0.95, velocity=1.8, integral=0.4, derivative=0.2)
_STOP_GAIN, _STOP_M_S2, _STOP_JERK_M_S3 = 2.5, 3.3, 9.4
_STICK_GAIN, _STICK_M_S2 = 3.0, 3.0


class Px4Control(FlightControl):
    """Loops of PX4."""

    def __init__(self, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        super().__init__(_GAINS, position, yaw, drag)

    def begin(self, manner: Manner, position: np.ndarray, velocity: np.ndarray, yaw: float) -> None:
        """Enter a mode; OFFBOARD holds until its first setpoint."""
        super().begin(manner, position, velocity, yaw)
        # The stop begins with the acceleration that is flown, and that of an airframe with friction carries on.
        self.push = list(self.lean)

    def _sensed(
        self, error: tuple[float, float], speed: tuple[float, float], dt: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        return error, (-speed[0], -speed[1])

    def _shape(self, here: tuple[float, float], speed: tuple[float, float], expired: bool, dt: float) -> None:
        target = self.target
        if self.manner == Manner.SETPOINTS:
            self.place = None if target.position is None else [float(v) for v in target.position[:2]]
            self.pace = [float(v) for v in target.velocity[:2]]
            self.push = [float(v) for v in target.acceleration[:2]]
        elif self.manner == Manner.STICK:
            gap = float(target.velocity[0]) - self.pace[0], float(target.velocity[1]) - self.pace[1]
            self._advance(limited(_STICK_GAIN * gap[0], _STICK_GAIN * gap[1], _STICK_M_S2), _STOP_JERK_M_S3, dt)
        else:
            self._stop_pace(_STOP_GAIN, _STOP_M_S2, _STOP_JERK_M_S3, dt)
