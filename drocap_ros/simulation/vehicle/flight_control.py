"""Position and velocity loops of an autopilot: what is common to all."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np

from drocap_ros.flight.autopilot import Autopilot
from drocap_ros.flight.autopilot.autopilot import Simulated
from drocap_ros.flight.autopilot.coasting import ContinuedCoasting

MAX_LEAN_M_S2 = 5.66  # 30 degrees
_MAX_CLIMB_M_S = 2.5  # as ArduPilot ships
_MAX_CLIMB_M_S2 = 3.0  # assumed


@dataclass
class Target:
    """What the autopilot follows, ENU; None = not commanded."""

    position: np.ndarray | None = None
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    acceleration: np.ndarray = field(default_factory=lambda: np.zeros(3))
    yaw: float | None = None
    yaw_rate: float = 0.0


class Manner(enum.Enum):
    """How a mode flies."""

    SETPOINTS = "follows setpoints"
    HOLD = "stops and stays"
    BRAKE = "stops sooner, and stays"
    STICK = "velocity of the pilot's stick"


class FlightControl:
    """Loops that command the body's acceleration; stops and sticks.

    A subclass shapes what they follow: ``place``, ``pace`` and ``push`` are the wanted horizontal position, velocity
    and acceleration; ``place`` None leaves the position free.
    """

    def __init__(self, simulated: Simulated, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        self._simulated, self.gains = simulated, simulated.gains
        self.target = Target(position=position.astype(float).copy(), yaw=yaw)
        self.manner = Manner.HOLD
        self.place: list[float] | None = [float(v) for v in position[:2]]
        self.pace, self.push = [0.0, 0.0], [0.0, 0.0]
        self.commanded_velocity: np.ndarray = np.zeros(3)
        self.lean = (0.0, 0.0)  # last horizontal command
        self._beyond = (0.0, 0.0)  # that command before its limit, where it was above it
        self._away, self._error = (0.0, 0.0), (0.0, 0.0)  # m/s, towards the place and of the velocity
        # In hover the integrals have already adapted to the wind.
        self._integral = [-float(v) for v in drag]
        self._derivative, self._before = [0.0, 0.0], [0.0, 0.0]

    def begin(self, manner: Manner, position: np.ndarray, velocity: np.ndarray, yaw: float) -> None:
        """Enter a mode at the estimated place and velocity."""
        self.manner = manner
        height = position[2] + velocity[2] * 0.4  # where it stops
        self.place = None if manner == Manner.STICK else [float(v) for v in position[:2]]
        self.pace = [float(v) for v in velocity[:2]]
        self.target = Target(position=np.array([*position[:2], height]), yaw=yaw)

    def take(self, target: Target) -> None:
        """Take a setpoint."""
        self.target = target

    def reset_estimate(self, shift: np.ndarray) -> None:
        """The estimated position jumps by (3,) m."""

    def command(self, position: np.ndarray, velocity: np.ndarray, expired: bool, dt: float) -> np.ndarray:
        """(3,) m/s^2 of thrust, from the estimated place and velocity; ``expired`` the last setpoint is too old."""
        here, speed = (float(position[0]), float(position[1])), (float(velocity[0]), float(velocity[1]))
        self._shape(here, expired, dt)
        gains, command = self.gains, [0.0, 0.0]
        toward = self._away = self._toward(here)
        error = toward[0] + self.pace[0] - speed[0], toward[1] + self.pace[1] - speed[1]
        error, changing = self._sensed(error, speed, dt)
        self._error = error
        blend = filter_share(dt)
        for i in (0, 1):
            self._derivative[i] += ((changing[i] - self._before[i]) / dt - self._derivative[i]) * blend
            self._before[i] = changing[i]
            command[i] = gains.velocity * error[i] + self._integral[i] + gains.derivative * self._derivative[i]
            command[i] += self.push[i]
        x, y = (self._integral[i] + gains.integral * error[i] * dt for i in (0, 1))
        if self._saturated(error):
            x, y = limited(x, y, math.hypot(*self._integral[:2]))
        self._integral[:2] = x, y
        self.lean = self._leaning(command[0], command[1])
        over = math.hypot(*command) > MAX_LEAN_M_S2
        self._beyond = (command[0], command[1]) if over else (0.0, 0.0)
        self.commanded_velocity = np.array([toward[0] + self.pace[0], toward[1] + self.pace[1], 0.0])
        return np.array([*self.lean, self._climb(float(position[2]), float(velocity[2]), dt)])

    def yaw_rate(self, yaw: float) -> float:
        """rad/s."""
        rate = self.target.yaw_rate
        if self.target.yaw is not None:
            # The gain, 1/s, gives the yaw errors of recorded orbits.
            rate += 5.8 * math.remainder(self.target.yaw - yaw, 2 * math.pi)
        return rate

    def _shape(self, here: tuple[float, float], expired: bool, dt: float) -> None:
        raise NotImplementedError

    def _sensed(
        self, error: tuple[float, float], speed: tuple[float, float], dt: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """(2,) m/s that the proportional and integral terms act on, and what the derivative term follows."""
        raise NotImplementedError

    def _leaning(self, x: float, y: float) -> tuple[float, float]:
        """(2,) m/s^2 as far as the vehicle may lean."""
        return limited(x, y, MAX_LEAN_M_S2)

    def _toward(self, here: tuple[float, float]) -> tuple[float, float]:
        """(2,) m/s towards ``place``."""
        if self.place is None:
            return 0.0, 0.0
        return self.gains.position * (self.place[0] - here[0]), self.gains.position * (self.place[1] - here[1])

    def _saturated(self, way: tuple[float, float]) -> bool:
        """Whether the vehicle cannot lean farther this way."""
        return way[0] * self._beyond[0] + way[1] * self._beyond[1] > 0.0

    def _climb(self, height: float, climb: float, dt: float) -> float:
        wanted = float(self.target.velocity[2])
        if self.target.position is not None:
            wanted += float(self.target.position[2]) - height  # a gain of 1/s as ArduPilot ships
        wanted = min(max(wanted, -_MAX_CLIMB_M_S), _MAX_CLIMB_M_S)
        self.commanded_velocity[2] = wanted
        error = wanted - climb
        self._integral[2] += 0.5 * error * dt
        command = 4.0 * error  # as ArduPilot ships
        return min(max(command, -_MAX_CLIMB_M_S2), _MAX_CLIMB_M_S2) + self._integral[2]

    def _without_setpoints(self, dt: float) -> None:
        """Move the wanted velocity towards that of the stick, or slow it down."""
        simulated = self._simulated
        if self.manner == Manner.STICK:
            decay, wanted = simulated.stick, (float(self.target.velocity[0]), float(self.target.velocity[1]))
        else:
            decay, wanted = simulated.stop if self.manner == Manner.BRAKE else simulated.hold, (0.0, 0.0)
        x, y = (decay.gain_per_s * (wanted[i] - self.pace[i]) for i in (0, 1))
        self._advance(limited(x, y, decay.most_m_s2), simulated.jerk_m_s3, dt)

    def _advance(self, wanted: tuple[float, float], jerk: float, dt: float) -> None:
        """Move the wanted place and velocity; its acceleration follows ``wanted`` within the jerk.

        They do not run away from a vehicle that leans as far as it may (as by ArduPilot's AC_PosControl).
        """
        change = limited(wanted[0] - self.push[0], wanted[1] - self.push[1], jerk * dt)
        faster = self.push[0] * dt, self.push[1] * dt
        if self.place is not None:
            way = (self.pace[0] + 0.5 * faster[0]) * dt, (self.pace[1] + 0.5 * faster[1]) * dt
            if not (self._saturated(way) and self._saturated(self._away)):
                self.place = [self.place[0] + way[0], self.place[1] + way[1]]
        if self._saturated(faster) and self._saturated(self._error):
            # A wanted velocity the other way may still be taken back.
            back = math.hypot(*self.pace) if self._saturated((-self.pace[0], -self.pace[1])) else 0.0
            faster = limited(*faster, back)
        self.pace = [self.pace[0] + faster[0], self.pace[1] + faster[1]]
        self.push = [self.push[0] + change[0], self.push[1] + change[1]]


def filter_share(dt: float) -> float:
    """Share of a new value in a low pass of 5 Hz, which both autopilots have."""
    # 5 Hz: PSC_NE_VEL_FLTE as shipped.
    return dt / (dt + 1 / (2 * math.pi * 5.0))


def limited(x: float, y: float, most: float) -> tuple[float, float]:
    """The vector, no longer than ``most``."""
    size = math.hypot(x, y)
    return (x, y) if size <= most else (x * most / size, y * most / size)


def rooted(x: float, y: float, gain: float, most: float) -> tuple[float, float]:
    """Rate that takes an error away: linear near zero, then its root, so that it falls by at most ``most`` per s."""
    error, near = math.hypot(x, y), most / gain**2
    if error <= near:
        return gain * x, gain * y
    rate = math.sqrt(2 * most * (error - near / 2))
    return x * rate / error, y * rate / error


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


class ContinuedControl(FlightControl):
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
            # 10 m/s: WP_SPD as shipped.
            closing = limited(*rooted(x, y, 0.5 * jerk / most, 0.5 * most), 10.0)
            ahead = ahead[0] + closing[0], ahead[1] + closing[1]
        ahead = limited(*rooted(*ahead, jerk / most, jerk), most)
        forward = float(target.acceleration[0]), float(target.acceleration[1])
        self._advance((ahead[0] + forward[0], ahead[1] + forward[1]), jerk, dt)
        if target.position is not None:
            target.position = target.position + target.velocity * dt + 0.5 * target.acceleration * dt * dt
        target.velocity = target.velocity + target.acceleration * dt


class HeldControl(FlightControl):
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
