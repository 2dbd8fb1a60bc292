"""How fast the orbit is flown: every rule, in the order in which they bound a setpoint.

1. :func:`coast_speed`: a vehicle without setpoints must stand within ``max_coast_m``.
2. :func:`allowed_angular_speed`: of the reference, by speed and acceleration at its radius; :func:`waiting`, for the
   vehicle; :func:`approach_speed` of the radius.  The ramps to them are those of ``planner.py``.
3. :func:`allowed_pace`: old data slow the orbit down, at once; fresh data restore the speed that is left, and the rest
   along a ramp.  The pace is the share of its speed at which it is flown: the time of the reference runs slower by this
   factor.  At pace 0 the setpoint stands where the vehicle was; only the ages of ``motion_checks.py`` end the orbit.
4. :func:`limit_closing`: the speed towards the subject, by the size of his image.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from drocap_ros.flight.autopilot.autopilot import Autopilot
from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.bridge_config import WORTH_TELLING, MavlinkBridgeConfig, OrbitConfig, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed, SizeSight
from drocap_ros.flight.orbit.motion_checks import (
    GUST_S,
    REACTION_S,
    WAITING_LEADS,
    keeping_condition,
    oldest_state_s,
    oldest_subject_s,
    outdated_condition,
    stalled_condition,
)
from drocap_ros.flight.orbit.states import Pace
from drocap_ros.flight.subject.guard import farness

_C = ConditionCode
_STANDING_AGE = 5 / 6  # of max_subject_age_s, 0.33 s: the last moving setpoint
_LEAST_PACE = 0.3  # share of its speed at which an orbit gives way still: one that stands would not
_CHANGE = 0.6  # 1/s; how fast a vehicle of 2 m/s brakes and accelerates, 1.2 m/s^2


# -- if no setpoint follows --------------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def greatest_speed(autopilot: Autopilot, timeout_s: float, longest_m: float) -> float:
    """Greatest speed in m/s at which a level flight straight ahead stops within ``longest_m``."""
    low, high = 0.0, 20.0
    while high - low > 0.01:
        speed = 0.5 * (low + high)
        velocity, zero = np.array([speed, 0.0, 0.0]), np.zeros(3)
        last = Setpoint(zero, velocity, zero, 0.0, 0.0)
        if autopilot.coast_of(last, zero, velocity, timeout_s).length_m > longest_m:
            high = speed
        else:
            low = speed
    return low


def timeout_s(seen: Observed) -> float:
    """For how long (s) the vehicle flies on without setpoints."""
    return seen.autopilot.timeout_s(seen.loss_settings)


def coast_speed(seen: Observed, config: MavlinkBridgeConfig) -> float:
    """Speed in m/s of a steady flight whose coast leaves room to ``max_coast_m``."""
    autopilot = seen.autopilot
    return greatest_speed(autopilot, timeout_s(seen), autopilot.steady_coast * config.max_coast_m)


def slowed_condition(present: Condition, goal: OrbitGoal, seen: Observed, config: MavlinkBridgeConfig) -> Condition:
    """The condition of a flown orbit, with the angular speed that is flown if the coast limits it."""
    wanted = abs(goal.angular_speed_rad_s)
    allowed = coast_speed(seen, config) / goal.radius_m
    if present.code not in (ConditionCode.ORBITING, ConditionCode.WIDENED) or allowed >= (1.0 - WORTH_TELLING) * wanted:
        return present
    return condition(
        ConditionCode.SLOWED,
        cause=present,
        speed_deg_s=math.degrees(allowed),
        wanted_deg_s=math.degrees(wanted),
        limit_m=config.max_coast_m,
        timeout_s=timeout_s(seen),
    )


# -- of the reference -------------------------------------------------------------------------------------------------


def allowed_angular_speed(
    wanted: float, radius: float, moving: np.ndarray, along: np.ndarray, greatest: float, config: OrbitConfig
) -> float:
    """Wanted angular speed in rad/s, limited by speed and acceleration at this radius.

    moving : (2,) m/s, what the orbit adds to: of the centre and of the radius
    along : (2,) direction in which it adds
    """
    by_acceleration = math.sqrt(config.max_acceleration_m_s2 / radius)
    ahead = float(moving @ along)
    room = greatest**2 - float(moving @ moving) + ahead**2
    by_speed = max(math.sqrt(max(room, 0.0)) - ahead, 0.0) / radius
    return math.copysign(min(abs(wanted), by_acceleration, by_speed), wanted)


def waiting(lead_m: float, most_m: float) -> tuple[float, float]:
    """Shares of its speed to which, and at once at which, the reference slows down ahead of a vehicle that lags behind.

    The ramp to the first one is too slow for a vehicle that suddenly falls behind.
    """
    # The reference does not wait below 0.6 of the greatest lead.
    share = (most_m - lead_m) / (0.4 * most_m)
    at_once = (WAITING_LEADS * most_m - lead_m) / (0.3 * most_m)  # from one greatest lead to 1.3 of them
    return min(max(share, 0.0), 1.0), min(max(at_once, 0.0), 1.0)


def approach_speed(radius_m: float, chase_m_s: float, config: OrbitConfig) -> float:
    """Speed of radius changes: slower behind a subject that walks away, because it may stop at once."""
    room = max(radius_m - config.min_distance_m, 0.0)
    return min(max(math.sqrt(room) - chase_m_s, 0.2), config.approach_speed_m_s)


# -- by the age of the data -------------------------------------------------------------------------------------------


def allowed_pace(seen: Observed, config: MavlinkBridgeConfig) -> tuple[float, Condition | None]:
    """The pace that the data allow, 0 to 1, by the greatest of the ages relative to their limits, and what reduces it.

    The ages are those of subject, attitude, position and link, and the stand of our own loop.
    """
    usual_s = config.max_state_age_s
    halt_s = 0.5 * (usual_s + oldest_state_s(config, patient=True))
    subject_s = min(oldest_subject_s(seen, config), _STANDING_AGE * config.max_subject_age_s)
    # A camera at 15 Hz, and 0.17 s for its network.
    usual_subject_s = min(0.24, 0.8 * subject_s)
    ages = (
        (seen.link.age_s, _C.LINK_SILENT),
        (seen.vehicle.age_s, _C.ATTITUDE_OUTDATED),
        (seen.vehicle.position_age_s, _C.POSITION_FROZEN),
    )
    other = _LEAST_PACE if seen.subject.contradicted else 1.0  # at once: most is flown after a jump before the hold
    pace, cause = min(
        (other, condition(_C.OTHER_SUBJECT, age_s=seen.subject.age_s)),
        (_share(seen.subject.age_s, usual_subject_s, subject_s), outdated_condition(seen, usual_subject_s)),
        (_share(seen.stalled_s, 0.0, halt_s), stalled_condition(seen)),
        *((_share(age_s, usual_s, halt_s), condition(code, age_s=age_s)) for age_s, code in ages),
        key=lambda found: found[0],
    )
    return (pace, cause) if pace < 1.0 else (1.0, keeping_condition(seen, config, GUST_S))  # the reference waits itself


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


# -- towards the subject ----------------------------------------------------------------------------------------------


def limit_closing(setpoint: Setpoint, seen: Observed, config: MavlinkBridgeConfig) -> Setpoint:
    """The setpoint with no more speed towards the subject than his size allows."""
    sight = seen.subject.by_size
    if sight is None:
        return setpoint
    room = math.sqrt(2 * config.braking_m_s2 * max(sight.nearest_m - config.min_distance_m, 0.0))
    # He may recede a little faster by his image, which shrinks as he bends, than by the estimated place; seen from 12 m
    # one who stands recedes at up to 0.4 m/s.
    receding = min(sight.receding_m_s, max(-seen.subject.approach_m_s, 0.0) + 0.1)
    receding = min(receding, max(receding - farness(sight.distance_m) * 0.3, 0.0))
    closing_up = 0.85 * config.max_closing_m_s  # the vehicle overshoots
    allowed = min(max(closing_up + receding, 0.0), room)
    if seen.autopilot.continues_setpoints:
        closing = float(seen.vehicle.velocity[:2] @ sight.toward)
        # Behind a walker such a vehicle closes up more slowly: a stop is seen 0.4 s late.
        allowed -= 0.3 * min(max(receding, 0.0), closing_up)
        # Its path, limited in jerk, overshoots a reversal: from 1.8 m/s away it closed up at 1.3 m/s without this.
        allowed += min(closing, 0.0)
        # It overshoots a larger step of the closing speed towards one who stands.
        allowed = max(min(allowed, max(closing, 0.0) + 0.4 + receding), 0.0)
    return _bounded(setpoint, seen, sight, allowed, config.max_acceleration_m_s2)


def _bounded(
    setpoint: Setpoint, seen: Observed, sight: SizeSight, allowed_m_s: float, max_acceleration_m_s2: float
) -> Setpoint:
    """The setpoint with no more speed towards the subject than allowed.

    The autopilot flies the setpoint's velocity and a share of the way to its position; their sum is bounded, at the
    cost of the position first.  Acceleration towards the subject turns the vehicle on its circle, and beyond that
    brings the present closing speed to the allowed one.
    """
    vehicle, gain = seen.vehicle, seen.autopilot.position_gain_per_s
    inward = np.append(sight.toward, 0.0)
    ahead, speed = float((setpoint.position - vehicle.position) @ inward), float(setpoint.velocity @ inward)
    excess = speed + gain * ahead - allowed_m_s
    place, flown = setpoint.position, setpoint.velocity
    if excess > 0:
        back = min(excess / gain, max(ahead, 0.0))
        place = place - back * inward
        flown = flown - min(excess - gain * back, max(speed, 0.0)) * inward
    velocity = vehicle.velocity
    closing = float(velocity @ inward)
    turning = max(float(velocity[:2] @ velocity[:2]) - closing**2, 0.0) / max(sight.distance_m, 0.5)
    most = max(turning + (allowed_m_s - closing) / REACTION_S, -max_acceleration_m_s2)
    acceleration = setpoint.acceleration - max(float(setpoint.acceleration @ inward) - most, 0.0) * inward
    size = float(np.linalg.norm(acceleration))
    acceleration = acceleration * min(1.0, max_acceleration_m_s2 / max(size, 1e-6))
    return setpoint._replace(position=place, velocity=flown, acceleration=acceleration)
