"""The first of three levels (degrade, hold, hand over): an orbit by old data slows down, and goes on with fresh data.

The pace is the share of its speed at which the orbit is flown: the time of the reference runs slower by this factor.
Old data reduce it at once; fresh data restore the speed that is left, and the rest along a ramp.  At pace 0 the
setpoint stands where the vehicle was then, and the orbit has not ended: only the ages of ``motion_checks.py`` end it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.motion_checks import (
    GUST_S,
    keeping_condition,
    oldest_state_s,
    oldest_subject_s,
    outdated_condition,
)
from drocap_ros.flight.orbit.states import Limits, Pace

_C = ConditionCode
_USUAL_SUBJECT_AGE_S = 0.24  # a camera at 15 Hz, and 0.17 s for its network
_STANDING_AGE = 5 / 6  # of max_subject_age_s, 0.33 s: the last moving setpoint
_LEAST_PACE = 0.3  # share of its speed at which an orbit gives way still: one that stands would not
_CHANGE = 0.6  # 1/s; how fast a vehicle of 2 m/s brakes and accelerates, 1.2 m/s^2


class Allowed(NamedTuple):
    """The pace that the data allow, 0 to 1, and the condition that reduces it."""

    pace: float
    cause: Condition | None


def allowed_pace(seen: Observed, limits: Limits) -> Allowed:
    """The pace by the greatest age, relative to its limits, of subject, attitude, position and link."""
    safety = limits.safety
    usual_s = safety.max_state_age_s
    halt_s = 0.5 * (usual_s + oldest_state_s(safety, patient=True))
    subject_s = min(oldest_subject_s(seen, safety), _STANDING_AGE * safety.max_subject_age_s)
    usual_subject_s = min(_USUAL_SUBJECT_AGE_S, 0.8 * subject_s)
    allowed = Allowed(1.0, None)
    if seen.subject.contradicted:  # at once: most of what is flown after a jump is flown before the hold
        allowed = Allowed(_LEAST_PACE, condition(_C.OTHER_SUBJECT, age_s=seen.subject.age_s))
    pace = _share(seen.subject.age_s, usual_subject_s, subject_s)
    if pace < allowed.pace:
        allowed = Allowed(pace, outdated_condition(seen, usual_subject_s))
    for age_s, code in (
        (seen.link.age_s, _C.LINK_SILENT),
        (seen.vehicle.age_s, _C.ATTITUDE_OUTDATED),
        (seen.vehicle.position_age_s, _C.POSITION_FROZEN),
    ):
        pace = _share(age_s, usual_s, halt_s)
        if pace < allowed.pace:
            allowed = Allowed(pace, condition(code, age_s=age_s))
    if allowed.cause is None:  # the reference waits by itself
        allowed = allowed._replace(cause=keeping_condition(seen, limits, GUST_S))
    return allowed


def _share(age_s: float, full_s: float, none_s: float) -> float:
    """1 up to the one age, 0 from the other one on."""
    if age_s <= full_s:
        return 1.0
    return max(none_s - age_s, 0.0) / (none_s - full_s) if none_s > full_s else 0.0


def next_pace(
    pace: Pace, allowed: float, now_s: float, vehicle: np.ndarray | None = None, *, contradicted: bool = False
) -> Pace:
    """The pace now: at most the allowed one, and at most the one that the vehicle has kept meanwhile.

    A vehicle does not lose its speed at once: after a short gap the orbit goes on from the speed that is left.  After
    a stand for pictures of something else it goes on along the whole ramp: the subject may be at another place.

    vehicle : (3,) m, its position
    contradicted : whether the pictures show something else
    """
    dt = now_s - pace.at_s
    kept = min(max(allowed, pace.kept - _CHANGE * dt), pace.kept + _CHANGE * dt)
    value = min(allowed, kept)
    if contradicted and value == 0.0:
        kept = 0.0
    place = vehicle if value > 0.0 or pace.place is None else pace.place
    return Pace(value, (kept - pace.kept) / dt if dt > 0.0 else 0.0, kept, now_s, place)


def slowed(setpoint: Setpoint, pace: Pace, max_acceleration_m_s2: float) -> Setpoint:
    """The setpoint of a reference whose time runs at this pace; a change of the pace is an acceleration.

    None at pace 0: an autopilot integrates the acceleration, and the setpoint stands where the vehicle was.
    """
    if pace.value == 1.0 and pace.rate == 0.0:
        return setpoint
    if pace.place is not None:
        way = min(pace.value / _LEAST_PACE, 1.0)  # below it the setpoint is nearer than the reference
        setpoint = setpoint._replace(position=pace.place + way * (setpoint.position - pace.place))
    acceleration = pace.value**2 * setpoint.acceleration
    if pace.value > 0.0:
        acceleration = acceleration + pace.rate * setpoint.velocity
    size = float(np.linalg.norm(acceleration))
    return setpoint._replace(
        velocity=pace.value * setpoint.velocity,
        acceleration=acceleration * min(1.0, max_acceleration_m_s2 / max(size, 1e-9)),
        yaw_rate=pace.value * setpoint.yaw_rate,
    )
