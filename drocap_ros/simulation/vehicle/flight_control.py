"""Position and velocity loops of an autopilot: what is common to all."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field

import numpy as np

from drocap_ros.flight.autopilot.simulated import Gains

MAX_LEAN_M_S2 = 5.66  # 30 degrees
_YAW_GAIN = 5.8  # 1/s: yaw errors of recorded orbits
_CLIMB_GAIN = 1.0  # 1/s of the height; this and the next two as ArduPilot ships
_CLIMB_RATE_GAIN = 4.0  # 1/s of the climb
_MAX_CLIMB_M_S = 2.5  # as ArduPilot ships
_MAX_CLIMB_M_S2 = 3.0  # assumed
_FILTER_HZ = 5.0  # of the velocity's error: PSC_NE_VEL_FLTE as shipped


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
    """Loops that command the body's acceleration.

    A subclass shapes what they follow: ``place``, ``pace`` and ``push`` are the wanted horizontal position, velocity
    and acceleration; ``place`` None leaves the position free.
    """

    def __init__(self, gains: Gains, position: np.ndarray, yaw: float, drag: np.ndarray) -> None:
        self.gains = gains
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
            rate += _YAW_GAIN * math.remainder(self.target.yaw - yaw, 2 * math.pi)
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
            wanted += _CLIMB_GAIN * (float(self.target.position[2]) - height)
        wanted = min(max(wanted, -_MAX_CLIMB_M_S), _MAX_CLIMB_M_S)
        self.commanded_velocity[2] = wanted
        error = wanted - climb
        self._integral[2] += 0.5 * error * dt
        command = _CLIMB_RATE_GAIN * error
        return min(max(command, -_MAX_CLIMB_M_S2), _MAX_CLIMB_M_S2) + self._integral[2]

    def _stop_pace(self, gain: float, most: float, jerk: float, dt: float) -> None:
        """Slow the wanted velocity down: rate ``gain`` per s, at most ``most`` m/s^2."""
        wanted = limited(-gain * self.pace[0], -gain * self.pace[1], most)
        self._advance(wanted, jerk, dt)

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
    return dt / (dt + 1 / (2 * math.pi * _FILTER_HZ))


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
