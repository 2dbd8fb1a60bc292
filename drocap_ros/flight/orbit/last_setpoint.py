"""The last check before the link: whether a setpoint is harmless if it stays the last one."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.autopilot.autopilot import greatest_speed
from drocap_ros.flight.autopilot.coasting import Coast
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.states import Limits
from drocap_ros.flight.orbit_goal import OrbitGoal
from drocap_ros.flight.setpoint import Setpoint, hold_setpoint
from drocap_ros.flight.subject.subject_filter import WALKING_M_S

#: Shares that are tried, one after the other: of the way to the reference, of velocity and of acceleration.  The way
#: comes first: with less velocity the vehicle would fall behind the reference, and the way to it would grow.
_SHARES = (
    (1.0, 1.0, 1.0), (0.5, 1.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.8, 0.5), (0.0, 0.6, 0.0), (0.0, 0.4, 0.0),
    (0.0, 0.2, 0.0),
)  # fmt: skip
#: Shares across the line of sight that are tried first where setpoints are held, and about one who walks: a vehicle
#: that falls behind along the orbit keeps its radius.  Where setpoints are continued, it would come near one who stands
#: too fast as the radius shrinks.
_ACROSS = (
    (1.0, 1.0, 1.0), (0.75, 1.0, 1.0), (0.5, 1.0, 1.0), (0.25, 1.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.8, 0.5),
    (0.0, 0.6, 0.0), (0.0, 0.4, 0.0),
)  # fmt: skip
#: Then a share along it is refined where such a vehicle retreats: it is hardly faster than one who walks up to it.
_HALVINGS = 3
_WALKED = 0.96  # of its longest coast, about one who walks: the vehicle follows him meanwhile


#: A far place that is held lets the vehicle fly faster than predicted: one that caught up with a walker went on
#: for 3.1 m.
#: Greatest speed of setpoint and way together beyond a steady flight's, m/s, and share of the subject's speed added.
_PULLED_M_S, _PULLED_BEHIND = 0.3, 0.25
#: Way nearer to the subject that forbids a setpoint, and that with the creep from which it is slowed down, m.
_NEARER_M, _CREEPS_NEARER_M = 1.0, 0.9
_SLACK_M, _SLACK_M_S = 0.2, 0.1  # what the vehicle has already is no effect of the setpoint
_SLOWED = 0.95


def coast_speed(seen: Observed, limits: Limits) -> float:
    """Speed in m/s of a steady flight whose coast leaves room to ``max_coast_m``."""
    autopilot = seen.autopilot
    return greatest_speed(autopilot, _timeout_s(seen), autopilot.coast.steady * limits.safety.max_coast_m)


def slowed_condition(present: Condition, goal: OrbitGoal, seen: Observed, limits: Limits) -> Condition:
    """The condition of a flown orbit, with the angular speed that is flown if the coast limits it."""
    wanted = abs(goal.angular_speed_rad_s)
    allowed = coast_speed(seen, limits) / goal.radius_m
    if present.code not in (ConditionCode.ORBITING, ConditionCode.WIDENED) or allowed >= _SLOWED * wanted:
        return present
    return condition(
        ConditionCode.SLOWED, cause=present, speed_deg_s=math.degrees(allowed), wanted_deg_s=math.degrees(wanted),
        limit_m=limits.safety.max_coast_m, timeout_s=_timeout_s(seen),
    )  # fmt: skip


def harmless(
    setpoint: Setpoint, seen: Observed, fence_centre: np.ndarray | None, limits: Limits
) -> tuple[Setpoint, Condition | None]:
    """The setpoint as it is sent, slowed down where its coast would break a limit.

    Where no motion is harmless, the setpoint holds the present position, and the condition is why.

    The coast must be short, and stay inside the fence and the greatest speed.  It must stay clear of the minimum
    distance from a subject that stands and from one that moves as estimated, and come at most 1 m nearer to that one;
    with the creep after its stop, what would come 0.9 m nearer is slowed down.

    Parameters
    ----------
    fence_centre : (2,) m; None = there is no fence
    """
    problem: Condition | None = None
    autopilot, subject_velocity = seen.autopilot, seen.subject.velocity
    longest, fastest = autopilot.coast.greatest * limits.safety.max_coast_m, math.inf
    walking = float(np.hypot(*subject_velocity[:2]))
    if not autopilot.continues_setpoints:
        fastest = coast_speed(seen, limits) + _PULLED_M_S + _PULLED_BEHIND * walking
    elif walking > WALKING_M_S:
        longest *= _WALKED
    tries = [(share, share) for share in _SHARES]
    if seen.subject.position is not None and (not autopilot.continues_setpoints or walking > WALKING_M_S):
        tries = [(_SHARES[0], share) for share in _ACROSS] + [(share, min(share, _ACROSS[-1])) for share in _SHARES[1:]]

    def judged(shares: np.ndarray) -> tuple[Setpoint, Condition | None, bool]:
        """Part of the setpoint by (2, 3) shares, its danger, and whether its coast is too long."""
        vectors = (setpoint.position - seen.vehicle.position, setpoint.velocity, setpoint.acceleration)
        way, velocity, acceleration = (
            _shared(vector, seen, *part) for vector, *part in zip(vectors, *shares, strict=True)
        )
        part = setpoint._replace(position=seen.vehicle.position + way, velocity=velocity, acceleration=acceleration)
        coast = autopilot.coast_of(part, seen.vehicle.position, seen.vehicle.velocity, _timeout_s(seen))
        long = coast.length_m > longest or math.hypot(*_commanded(part, seen)) > fastest
        long |= _creeps_nearer(coast, seen, complex(*subject_velocity[:2])) > _CREEPS_NEARER_M
        return part, _danger(coast, seen, complex(*subject_velocity[:2]), fence_centre, limits), long

    above = tries[0]
    for shares in tries:
        part, problem, long = judged(np.array(shares))
        # A coast that is only long is not shorter after a hold: the slowest setpoint is sent.
        if problem is None and (not long or shares[0] == _SHARES[-1]):
            break
        above = shares
    else:
        return hold_setpoint(seen.vehicle.position, seen.vehicle.yaw), problem
    if not autopilot.continues_setpoints and not long and shares[0] != above[0] and _retreats(setpoint, seen):
        least, greatest = np.array(shares), np.array(above)
        for _ in range(_HALVINGS):
            middle = 0.5 * (least + greatest)
            more, danger, long = judged(middle)
            if danger is None and not long:
                part, least = more, middle
            else:
                greatest = middle
    return part, None


def _commanded(setpoint: Setpoint, seen: Observed) -> np.ndarray:
    """(2,) m/s that the autopilot commands: of the setpoint, and of the way to its place."""
    way = setpoint.position - seen.vehicle.position
    return (setpoint.velocity + seen.autopilot.position_gain_per_s * way)[:2]


def _retreats(setpoint: Setpoint, seen: Observed) -> bool:
    """Whether the vehicle is to fly away from the subject."""
    if seen.subject.position is None:
        return False
    return float(_commanded(setpoint, seen) @ (seen.subject.position - seen.vehicle.position)[:2]) < 0.0


def _shared(vector: np.ndarray, seen: Observed, along: float, across: float) -> np.ndarray:
    """Shares of a vector along the horizontal line of sight, and of the rest of it."""
    if seen.subject.position is None or along == across:
        return along * vector
    sight = np.append((seen.subject.position - seen.vehicle.position)[:2], 0.0)
    part = (vector @ sight) / max(float(sight @ sight), 0.01) * sight
    return across * vector + (along - across) * part


def _danger(
    coast: Coast, seen: Observed, subject_velocity: complex, fence_centre: np.ndarray | None, limits: Limits
) -> Condition | None:
    speed = float(coast.speed_m_s.max())
    if speed > max(limits.orbit.max_speed_m_s, float(coast.speed_m_s[0]) + _SLACK_M_S):
        return condition(ConditionCode.COAST_UNSAFE, reach=f"reach {speed:.1f} m/s")
    if fence_centre is not None:
        away = np.abs(coast.place - complex(*fence_centre))
        if away.max() > max(limits.safety.fence_radius_m, float(away[0]) + _SLACK_M):
            fence_m = limits.safety.fence_radius_m
            return condition(ConditionCode.AT_FENCE, distance_m=float(away[0]), limit_m=fence_m)
    if seen.subject.position is None:
        return None
    subject, least = complex(*seen.subject.position[:2]), limits.orbit.min_distance_m
    stands = np.abs(coast.place - subject)
    walks = np.abs(coast.place - subject - subject_velocity * coast.time_s)
    alone = np.abs(coast.place[0] - subject - subject_velocity * coast.time_s)  # distances of a vehicle that stands
    near = min(
        (float(distance.min()) for distance, limit in (
            (stands, min(least, float(stands[0]) - _SLACK_M)),
            (walks, max(min(least, float(alone.min()) - _SLACK_M), float(alone.min()) - _NEARER_M)),
        ) if distance.min() < limit), default=math.nan,
    )  # fmt: skip
    return None if math.isnan(near) else condition(ConditionCode.COAST_UNSAFE, reach=f"come to {near:.1f} m")


def _creeps_nearer(coast: Coast, seen: Observed, subject_velocity: complex) -> float:
    """Way (m) nearer, creep included, to a subject who moves as estimated; his own approach does not count."""
    if seen.subject.position is None:
        return 0.0
    now = complex(*seen.subject.position[:2])
    then = now + subject_velocity * float(coast.time_s[-1])
    alone = min(abs(coast.place[0] - now), abs(coast.place[0] - then))
    return alone - abs(coast.place[-1] - then) + coast.creep_towards(then)


def _timeout_s(seen: Observed) -> float:
    return seen.autopilot.timeout_s(seen.loss_settings)
