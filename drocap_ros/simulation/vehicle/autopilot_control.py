"""How autopilots follow setpoints and stop: continued along a path, or held as they came."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.autopilot import Autopilot
from drocap_ros.flight.autopilot.coasting import ContinuedCoasting
from drocap_ros.flight.autopilot.simulated import Simulated
from drocap_ros.simulation.vehicle.flight_control import (
    MAX_LEAN_M_S2,
    FlightControl,
    Manner,
    Target,
    filter_share,
    limited,
    rooted,
)

_MAX_M_S = 10.0  # of the path: WP_SPD as shipped


def control_of(autopilot: Autopilot, position: np.ndarray, yaw: float, drag: np.ndarray) -> FlightControl:
    """The loops of an autopilot in a hover."""
    assert autopilot.simulated is not None
    if isinstance(autopilot.coasting, ContinuedCoasting):
        return ContinuedControl(autopilot.simulated, autopilot.coasting, position, yaw, drag)
    return HeldControl(autopilot.simulated, position, yaw, drag)


def manner_of(autopilot: Autopilot, mode: str) -> Manner:
    """How the autopilot flies in this mode.  Where the pilot steers, the sticks are centred."""
    if mode == autopilot.control_mode:
        return Manner.SETPOINTS
    return Manner.BRAKE if mode == autopilot.hold_mode else Manner.HOLD


class _AutopilotControl(FlightControl):
    """Stops and sticks."""

    def __init__(self, simulated: Simulated, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        super().__init__(simulated.gains, position, yaw, drag)
        self._simulated = simulated

    def _without_setpoints(self, dt: float) -> None:
        simulated, stick = self._simulated, self._simulated.stick
        if self.manner == Manner.STICK:
            gap = (float(self.target.velocity[i]) - self.pace[i] for i in (0, 1))
            x, y = (stick.gain_per_s * v for v in gap)
            self._advance(limited(x, y, stick.most_m_s2), simulated.jerk_m_s3, dt)
        else:
            decay = simulated.stop if self.manner == Manner.BRAKE else simulated.hold
            self._stop_pace(decay.gain_per_s, decay.most_m_s2, simulated.jerk_m_s3, dt)


class ContinuedControl(_AutopilotControl):
    """Velocity grows by the acceleration, the position by both, until the time-out.

    Then velocity and acceleration become zero and the place that was reached is the target.  A copy of the target,
    limited in acceleration and jerk, is what the loops follow: it overshoots and springs back.  Path and loops are
    those of ArduPilot's AC_PosControl with the parameters that Copter ships with; stops and airframe were fitted to the
    recorded flights of its simulation.
    """

    def __init__(
        self, simulated: Simulated, path: ContinuedCoasting, position: np.ndarray, yaw: float, drag: np.ndarray
    ) -> None:
        super().__init__(simulated, position, yaw, drag)
        self._most_m_s2, self._jerk_m_s3 = path.acceleration_m_s2, path.jerk_m_s3
        self._filtered = (0.0, 0.0)

    def begin(self, manner: Manner, position: np.ndarray, velocity: np.ndarray, yaw: float) -> None:
        """Enter a mode; that for setpoints starts with a stop."""
        if self.manner != Manner.SETPOINTS:
            self.push = [0.0, 0.0]
        super().begin(manner, position, velocity, yaw)
        if manner == Manner.SETPOINTS:
            stop_m = rooted(float(velocity[0]), float(velocity[1]), 1.0, self._most_m_s2)
            assert self.target.position is not None
            self.target.position[:2] += stop_m

    def take(self, target: Target) -> None:
        """Take a setpoint."""
        if (target.position is None) != (self.target.position is None):
            self.place = None if target.position is None else self.place
        super().take(target)

    def reset_estimate(self, shift: np.ndarray) -> None:
        """The path moves with a reset of the estimate; the setpoint that was sent stays."""
        if self.place is not None:
            self.place = [self.place[i] + float(shift[i]) for i in (0, 1)]

    def _sensed(
        self, error: tuple[float, float], _speed: tuple[float, float], dt: float
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

    def _shape(self, here: tuple[float, float], expired: bool, dt: float) -> None:
        if self.manner != Manner.SETPOINTS:
            self._without_setpoints(dt)
            return
        target, most, jerk = self.target, self._most_m_s2, self._jerk_m_s3
        if expired:
            target.velocity, target.acceleration, target.yaw_rate = np.zeros(3), np.zeros(3), 0.0
        ahead = float(target.velocity[0]) - self.pace[0], float(target.velocity[1]) - self.pace[1]
        if self.place is None:
            self.place = list(here)
        if target.position is not None:
            # Jerk over acceleration is the gain for the velocity, half of it that for the place.
            x, y = (float(target.position[i]) - self.place[i] for i in (0, 1))
            closing = limited(*rooted(x, y, 0.5 * jerk / most, 0.5 * most), _MAX_M_S)
            ahead = ahead[0] + closing[0], ahead[1] + closing[1]
        ahead = limited(*rooted(*ahead, jerk / most, jerk), most)
        forward = float(target.acceleration[0]), float(target.acceleration[1])
        self._advance((ahead[0] + forward[0], ahead[1] + forward[1]), jerk, dt)
        if target.position is not None:
            target.position = target.position + target.velocity * dt + 0.5 * target.acceleration * dt * dt
        target.velocity = target.velocity + target.acceleration * dt


class HeldControl(_AutopilotControl):
    """A setpoint does not move on: its position, velocity and acceleration act together until the mode changes.

    Fitted to the recorded flights of PX4's SIH simulator.
    """

    def begin(self, manner: Manner, position: np.ndarray, velocity: np.ndarray, yaw: float) -> None:
        """Enter a mode; that for setpoints holds until its first setpoint."""
        super().begin(manner, position, velocity, yaw)
        # The stop begins with the acceleration that is flown, and that of an airframe with friction carries on.
        self.push = list(self.lean)

    def _sensed(
        self, error: tuple[float, float], speed: tuple[float, float], _dt: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        return error, (-speed[0], -speed[1])

    def _shape(self, _here: tuple[float, float], _expired: bool, dt: float) -> None:
        target = self.target
        if self.manner != Manner.SETPOINTS:
            self._without_setpoints(dt)
            return
        self.place = None if target.position is None else [float(v) for v in target.position[:2]]
        self.pace = [float(v) for v in target.velocity[:2]]
        self.push = [float(v) for v in target.acceleration[:2]]
