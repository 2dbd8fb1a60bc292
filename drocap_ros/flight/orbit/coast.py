"""The vehicle's motion until it stands if no setpoint followed: every setpoint may be the last one.

After the death of the bridge the autopilot flies the last setpoint until its time-out.  ArduPilot integrates the
velocity and the acceleration, then brakes along a path limited in acceleration and jerk, and overshoots; PX4 follows
velocity and position as they are, brakes, then creeps on.  Both models are compared with recorded flights of the real
autopilots (``test/flight/orbit/test_coast.py``).  Vectors of the plane are complex numbers here: a step costs
microseconds.
"""

from __future__ import annotations

import cmath
import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.setpoint import Setpoint

_STEP_S, _LONGEST_S = 0.05, 5.0
_ACCELERATION, _JERK = 2.5, 5.0  # m/s^2, m/s^3, of ArduPilot's path, as shipped
_EXCESS = 1.1  # of ArduPilot's real distances over the predicted ones: lag, wind
PX4_POSITION_GAIN = 0.95  # 1/s, of its position loop (MPC_XY_P)
_PULL = 0.6  # 1/s: so much of it is left, the rest makes up for friction (recorded flights lie 1 m behind their place)
_PX4_DELAY_S, _PX4_FOLLOWS_S, _PX4_BRAKING = 0.1, 0.5, 1.4  # s, s, m/s^2: measured
_PX4_PUSH_S = 0.3  # s: its velocity loop passes acceleration on; with more, recorded flights stop too soon
_STANDING_M_S = {"ardupilot": 0.2, "px4": 0.5}
_CREEP_M = 0.8  # PX4 creeps at up to 0.4 m/s for seconds (measured)


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


def coast_of(setpoint: Setpoint, position: np.ndarray, velocity: np.ndarray, autopilot: str, timeout_s: float) -> Coast:
    """Horizontal motion from here until the vehicle stands, if this setpoint is the last one.

    Parameters
    ----------
    position, velocity : (3,) m, m/s of the vehicle, in the frame of the setpoint
    timeout_s : after which the autopilot ends the motion
    """
    place, moving = complex(*position[:2]), complex(*velocity[:2])
    goal, wanted, push = (complex(*v[:2]) for v in (setpoint.position, setpoint.velocity, setpoint.acceleration))
    if autopilot == "px4":
        return _px4(place, moving, goal, wanted + _PX4_PUSH_S * push, timeout_s)
    return _ardupilot(place, moving, goal, wanted, push, timeout_s)


@lru_cache(maxsize=64)
def greatest_speed(autopilot: str, timeout_s: float, longest_m: float) -> float:
    """Greatest speed in m/s at which a level flight straight ahead stops within ``longest_m``."""
    low, high = 0.0, 20.0
    while high - low > 0.01:
        speed = 0.5 * (low + high)
        velocity, zero = np.array([speed, 0.0, 0.0]), np.zeros(3)
        last = Setpoint(zero, velocity, zero, 0.0, 0.0)
        if coast_of(last, zero, velocity, autopilot, timeout_s).length_m > longest_m:
            high = speed
        else:
            low = speed
    return low


def _ardupilot(
    place: complex, velocity: complex, goal: complex, wanted: complex, push: complex, timeout_s: float
) -> Coast:
    # Of the setpoint's acceleration only what does not slow down counts from the first moment: it may be a new one.
    along = _direction(velocity)
    acceleration = push - min((push * along.conjugate()).real, 0.0) * along
    rows = [(0.0, place, abs(velocity))]
    dt, t = _STEP_S, 0.0
    while t < _LONGEST_S and (t <= timeout_s or abs(velocity) > _STANDING_M_S["ardupilot"]):
        if t >= timeout_s:
            wanted = push = 0j
        goal += (wanted + 0.5 * push * dt) * dt
        wanted += push * dt
        approach = wanted + _approach(goal - place, 0.5 * _JERK / _ACCELERATION, 0.5 * _ACCELERATION)
        change = _braking_first(_approach(approach - velocity, _JERK / _ACCELERATION, _JERK), velocity) + push
        acceleration += _limited(change - acceleration, _JERK * dt)
        place += (velocity + 0.5 * acceleration * dt) * dt
        velocity += acceleration * dt
        t += dt
        rows.append((t, place, abs(velocity)))
    return _coast(rows, _EXCESS)


def _px4(place: complex, velocity: complex, goal: complex, wanted: complex, timeout_s: float) -> Coast:
    rows = [(0.0, place, abs(velocity))]
    dt, t = _STEP_S, 0.0
    while t < _LONGEST_S and (t <= timeout_s or abs(velocity) > _STANDING_M_S["px4"]):
        if t < timeout_s + _PX4_DELAY_S:
            velocity += (wanted + _PULL * (goal - place) - velocity) * dt / _PX4_FOLLOWS_S
        else:
            velocity *= max(1.0 - _PX4_BRAKING * dt / max(abs(velocity), 1e-9), 0.0)
        place += velocity * dt
        t += dt
        rows.append((t, place, abs(velocity)))
    coast = _coast(rows)
    return coast._replace(creep_m=_CREEP_M * min(float(coast.speed_m_s.max()) / _STANDING_M_S["px4"], 1.0))


def _approach(error: complex, gain: float, limit: float) -> complex:
    """Rate that ends an error: linear near zero, the square root beyond, so that ``limit`` suffices to slow down."""
    size = abs(error)
    linear = limit / gain**2
    rate = size * gain if size <= linear else math.sqrt(2 * limit * (size - 0.5 * linear))
    return error * (rate / size) if size > 1e-9 else 0j


def _braking_first(change: complex, velocity: complex) -> complex:
    """Acceleration within the limit: braking before turning, turning before speeding up."""
    along = _direction(velocity)
    turned = change * along.conjugate()
    if turned.real < 0:
        slow = max(turned.real, -_ACCELERATION)
        room = math.sqrt(max(_ACCELERATION**2 - slow**2, 0.0))
        return complex(slow, min(max(turned.imag, -room), room)) * along
    aside = min(max(turned.imag, -_ACCELERATION), _ACCELERATION)
    return complex(min(turned.real, math.sqrt(max(_ACCELERATION**2 - aside**2, 0.0))), aside) * along


def _direction(vector: complex) -> complex:
    return vector / abs(vector) if abs(vector) > 1e-6 else 1 + 0j


def _limited(vector: complex, length: float) -> complex:
    return vector if abs(vector) <= length else cmath.rect(length, cmath.phase(vector))


def _coast(rows: list[tuple[float, complex, float]], excess: float = 1.0) -> Coast:
    times, places, speeds = (np.array(column) for column in zip(*rows, strict=True))
    return Coast(times, places[0] + excess * (places - places[0]), speeds)
