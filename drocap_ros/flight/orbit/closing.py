"""The closing speed: no setpoint moves faster towards the subject than the size of his image allows.

It is at most ``max_closing_m_s``, and leaves room to stop before ``min_distance_m`` if the body is smaller than
assumed.
A subject who recedes may be followed as fast as his image surely shrinks, and little faster than his estimated place
recedes: while it keeps its size, following does not close.
"""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.observed import Motion, Observed
from drocap_ros.flight.orbit.states import Limits
from drocap_ros.flight.setpoint import Setpoint
from drocap_ros.flight.subject.guard import farness

_OVERSHOOT = 0.85  # of the greatest closing speed that a setpoint has: the vehicle overshoots
_SURELY_M_S = 0.1  # so much faster than by the estimated place he may recede by his image, which shrinks as he bends
#: m/s that his receding must exceed far away: from 12 m one who stands recedes at up to 0.4 m/s for a second.
_FAR_ERROR_M_S = 0.3
_POSITION_GAIN = 1.0  # 1/s, the greatest of the autopilots' position loops
_REACTION_S = 0.5
#: Most that a setpoint adds to the present closing speed towards one who stands, where setpoints are continued: the
#: vehicle overshoots a larger step.
_STEP_M_S = 0.4
#: Share of the speed at which such a vehicle follows a walker, by which it closes up more slowly: a stop is seen 0.4 s
#: late.
_STOPS = 0.3


def limit_closing(setpoint: Setpoint, seen: Observed, limits: Limits) -> Setpoint:
    """The setpoint with no more speed towards the subject than his size allows."""
    sight, orbit = seen.subject.by_size, limits.orbit
    if sight is None:
        return setpoint
    room = math.sqrt(2 * limits.safety.braking_m_s2 * max(sight.nearest_m - orbit.min_distance_m, 0.0))
    receding = min(sight.receding_m_s, max(-seen.subject.approach_m_s, 0.0) + _SURELY_M_S)
    receding = min(receding, max(receding - farness(sight.distance_m) * _FAR_ERROR_M_S, 0.0))
    closing_up = _OVERSHOOT * orbit.max_closing_m_s
    allowed = min(max(closing_up + receding, 0.0), room)
    if seen.autopilot.continues_setpoints:
        closing = float(seen.vehicle.velocity[:2] @ sight.toward)
        allowed -= _STOPS * min(max(receding, 0.0), closing_up)
        # Its path, limited in jerk, overshoots a reversal: from 1.8 m/s away it closed up at 1.3 m/s without this.
        allowed += min(closing, 0.0)
        allowed = max(min(allowed, max(closing, 0.0) + _STEP_M_S + receding), 0.0)
    return _bounded(setpoint, seen.vehicle, sight.toward, sight.distance_m, allowed, orbit.max_acceleration_m_s2)


def _bounded(
    setpoint: Setpoint,
    vehicle: Motion,
    toward: np.ndarray,
    distance: float,
    allowed_m_s: float,
    max_acceleration_m_s2: float,
) -> Setpoint:
    """The setpoint with no more speed towards the subject than allowed.

    The autopilot flies the setpoint's velocity and a share of the way to its position; their sum is bounded, at the
    cost of the position first.  Acceleration towards the subject turns the vehicle on its circle, and beyond that
    brings the present closing speed to the allowed one.
    """
    inward = np.append(toward, 0.0)
    ahead, speed = float((setpoint.position - vehicle.position) @ inward), float(setpoint.velocity @ inward)
    excess = speed + _POSITION_GAIN * ahead - allowed_m_s
    place, flown = setpoint.position, setpoint.velocity
    if excess > 0:
        back = min(excess / _POSITION_GAIN, max(ahead, 0.0))
        place = place - back * inward
        flown = flown - min(excess - _POSITION_GAIN * back, max(speed, 0.0)) * inward
    velocity = vehicle.velocity
    closing = float(velocity @ inward)
    turning = max(float(velocity[:2] @ velocity[:2]) - closing**2, 0.0) / max(distance, 0.5)
    most = max(turning + (allowed_m_s - closing) / _REACTION_S, -max_acceleration_m_s2)
    acceleration = setpoint.acceleration - max(float(setpoint.acceleration @ inward) - most, 0.0) * inward
    size = float(np.linalg.norm(acceleration))
    acceleration = acceleration * min(1.0, max_acceleration_m_s2 / max(size, 1e-6))
    return setpoint._replace(position=place, velocity=flown, acceleration=acceleration)
