"""The vehicle's motion until it stands if no setpoint followed: every setpoint may be the last one.

After the death of the bridge the autopilot flies the last setpoint until its time-out.  The two models here are
compared with recorded flights of the real autopilots (``test/flight/autopilot/test_coasting.py``).  Vectors of the
plane are complex numbers: a step costs microseconds.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol

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


_STEP_S = 0.05  # of the prediction: the period of the setpoints, so that a coast is as fine as what is sent
_LONGEST_S = 5.0  # of a prediction: every recorded vehicle stood sooner


class Coast(NamedTuple):
    """Predicted motion after a setpoint that stays the last one: times (N,) s, places (N,) and speeds (N,).

    creep_m : way that the vehicle creeps afterwards
    """

    time_s: np.ndarray
    place: np.ndarray
    speed_m_s: np.ndarray
    creep_m: float = 0.0

    @property
    def length_m(self) -> float:
        """Greatest distance from the first place, m, the creep included."""
        return float(np.abs(self.place - self.place[0]).max()) + self.creep_m

    def creep_towards(self, place: complex) -> float:
        """Part of the creep (m) that leads towards a place, if the vehicle creeps on the way that it went."""
        way, sight = self.place[-1] - self.place[0], place - self.place[-1]
        length = abs(way) * abs(sight)
        return self.creep_m * max(float((way * sight.conjugate()).real) / length, 0.0) if length > 1e-6 else 0.0


class Coasting(Protocol):
    """How an autopilot flies on without setpoints."""

    def after(
        self, place: complex, velocity: complex, goal: complex, wanted: complex, push: complex, timeout_s: float
    ) -> Coast:
        """Horizontal motion until the vehicle stands; the autopilot ends the setpoint's motion after ``timeout_s``.

        place, velocity : of the vehicle, m, m/s; goal, wanted, push : of the setpoint, m, m/s, m/s^2
        """


@dataclass(frozen=True)
class ContinuedCoasting:
    """The autopilot integrates velocity and acceleration, brakes along a path limited in both, and overshoots.

    acceleration_m_s2, jerk_m_s3 : limits of the path
    excess : real distances over the predicted ones
    standing_m_s : below which the vehicle stands
    """

    acceleration_m_s2: float
    jerk_m_s3: float
    excess: float
    standing_m_s: float

    def after(
        self, place: complex, velocity: complex, goal: complex, wanted: complex, push: complex, timeout_s: float
    ) -> Coast:
        """See :class:`Coasting`."""
        most, jerk = self.acceleration_m_s2, self.jerk_m_s3
        # Of the setpoint's acceleration only what does not slow down counts from the first moment: it may be a new one.
        along = _direction(velocity)
        acceleration = push - min((push * along.conjugate()).real, 0.0) * along
        rows = [(0.0, place, abs(velocity))]
        dt, t = _STEP_S, 0.0
        while t < _LONGEST_S and (t <= timeout_s or abs(velocity) > self.standing_m_s):
            if t >= timeout_s:
                wanted = push = 0j
            goal += (wanted + 0.5 * push * dt) * dt
            wanted += push * dt
            # The gain for the velocity is jerk over acceleration, that for the place half of it.
            approach = wanted + _approach(goal - place, 0.5 * jerk / most, 0.5 * most)
            change = _braking_first(_approach(approach - velocity, jerk / most, jerk), velocity, most) + push
            acceleration += _limited(change - acceleration, jerk * dt)
            place += (velocity + 0.5 * acceleration * dt) * dt
            velocity += acceleration * dt
            t += dt
            rows.append((t, place, abs(velocity)))
        return _coast(rows, self.excess)


@dataclass(frozen=True)
class HeldCoasting:
    """The autopilot follows velocity and position of the setpoint as they came, brakes, then creeps on.

    pull_per_s : of the way to the setpoint's place
    push_s : velocity for each m/s^2 of the setpoint's acceleration
    delay_s : from the time-out to the braking
    follows_s : lag of the velocity
    braking_m_s2 : after the time-out
    creep_m : at most, afterwards
    standing_m_s : below which the vehicle stands
    """

    pull_per_s: float
    push_s: float
    delay_s: float
    follows_s: float
    braking_m_s2: float
    creep_m: float
    standing_m_s: float

    def after(
        self, place: complex, velocity: complex, goal: complex, wanted: complex, push: complex, timeout_s: float
    ) -> Coast:
        """See :class:`Coasting`."""
        wanted += self.push_s * push
        rows = [(0.0, place, abs(velocity))]
        dt, t = _STEP_S, 0.0
        while t < _LONGEST_S and (t <= timeout_s or abs(velocity) > self.standing_m_s):
            if t < timeout_s + self.delay_s:
                velocity += (wanted + self.pull_per_s * (goal - place) - velocity) * dt / self.follows_s
            else:
                velocity *= max(1.0 - self.braking_m_s2 * dt / max(abs(velocity), 1e-9), 0.0)
            place += velocity * dt
            t += dt
            rows.append((t, place, abs(velocity)))
        coast = _coast(rows)
        return coast._replace(creep_m=self.creep_m * min(float(coast.speed_m_s.max()) / self.standing_m_s, 1.0))


def _approach(error: complex, gain: float, limit: float) -> complex:
    """Rate that ends an error: linear near zero, the square root beyond, so that ``limit`` suffices to slow down."""
    size = abs(error)
    linear = limit / gain**2
    rate = size * gain if size <= linear else math.sqrt(2 * limit * (size - 0.5 * linear))
    return error * (rate / size) if size > 1e-9 else 0j


def _braking_first(change: complex, velocity: complex, most: float) -> complex:
    """Acceleration within the limit: braking before turning, turning before speeding up."""
    along = _direction(velocity)
    turned = change * along.conjugate()
    if turned.real < 0:
        slow = max(turned.real, -most)
        room = math.sqrt(max(most**2 - slow**2, 0.0))
        return complex(slow, min(max(turned.imag, -room), room)) * along
    aside = min(max(turned.imag, -most), most)
    return complex(min(turned.real, math.sqrt(max(most**2 - aside**2, 0.0))), aside) * along


def _direction(vector: complex) -> complex:
    return vector / abs(vector) if abs(vector) > 1e-6 else 1 + 0j


def _limited(vector: complex, length: float) -> complex:
    return vector if abs(vector) <= length else cmath.rect(length, cmath.phase(vector))


def _coast(rows: list[tuple[float, complex, float]], excess: float = 1.0) -> Coast:
    times, places, speeds = (np.array(column) for column in zip(*rows, strict=True))
    return Coast(times, places[0] + excess * (places - places[0]), speeds)
