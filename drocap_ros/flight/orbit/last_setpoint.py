"""A setpoint may be the last one: what is added to it and taken from it, so that it is harmless if nothing follows.

After the death of the bridge the autopilot flies the last setpoint until its time-out, and then stops by itself; how it
does (time-out, deceleration, gain) is a matter of its object.  One pass in three steps: :class:`Shortfall` adds what a
vehicle behind a walking subject lacks, :func:`limit_closing` bounds the speed towards the subject by the size of his
image, and :func:`harmless` takes away what would break a limit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.autopilot import greatest_speed
from drocap_ros.flight.autopilot.coasting import Coast, Setpoint, hold_setpoint
from drocap_ros.flight.bridge_config import WORTH_TELLING, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed, SizeSight
from drocap_ros.flight.orbit.motion_checks import OWN_SPEED_SD_M_S, REACTION_S
from drocap_ros.flight.orbit.states import Limits
from drocap_ros.flight.subject.guard import farness
from drocap_ros.flight.subject.subject_filter import STANDING_M_S, WALKING_M_S

#: m; no coast, the creep after its stop included, brings the vehicle by more nearer to the subject: 1 m is required of
#: the bridge's death (benchmarks/flight_kills.py), and the prediction errs.
_NEARER_M = 0.9
#: Share of a steady flight's and of the subject's speed, by which setpoint and way together may ask more than a steady
#: flight's of a vehicle that holds setpoints.  A far place lets it fly faster than predicted: after it had caught up
#: with a walker it went on for 3.1 m.
_PULLED = 0.25
_SLACK_M = 0.2  # what the vehicle has already is no effect of the setpoint
#: Levels that are tried, one after the other, see :func:`_shares`: of the setpoint's part along and of that across the
#: line of sight, both at once or the one across first.  A step is a fifth of the speed, a quarter or half of the way.
_LEVELS = (2.0, 1.5, 1.0, 0.8, 0.6, 0.4, 0.2)
_TRIES = [(level, level) for level in _LEVELS]
_TRIES_ACROSS_FIRST = [(2.0, across) for across in (2.0, 1.75, 1.5, 1.25, 1.0, 0.8, 0.6, 0.4)]
_TRIES_ACROSS_FIRST += [(level, min(level, 0.4)) for level in _LEVELS[1:]]
_HALVINGS = 3  # between two levels, where setpoints are held: a vehicle that lacks more retreats no more slowly


def coast_speed(seen: Observed, limits: Limits) -> float:
    """Speed in m/s of a steady flight whose coast leaves room to ``max_coast_m``."""
    autopilot = seen.autopilot
    return greatest_speed(autopilot, _timeout_s(seen), autopilot.coast.steady * limits.safety.max_coast_m)


def slowed_condition(present: Condition, goal: OrbitGoal, seen: Observed, limits: Limits) -> Condition:
    """The condition of a flown orbit, with the angular speed that is flown if the coast limits it."""
    wanted = abs(goal.angular_speed_rad_s)
    allowed = coast_speed(seen, limits) / goal.radius_m
    if present.code not in (ConditionCode.ORBITING, ConditionCode.WIDENED) or allowed >= (1.0 - WORTH_TELLING) * wanted:
        return present
    return condition(
        ConditionCode.SLOWED,
        cause=present,
        speed_deg_s=math.degrees(allowed),
        wanted_deg_s=math.degrees(wanted),
        limit_m=limits.safety.max_coast_m,
        timeout_s=_timeout_s(seen),
    )


# -- harmless ---------------------------------------------------------------------------------------------------------


class _Coasting(NamedTuple):
    """What the coast of a part of the setpoint is judged by: the subject's velocity, the fence, lengths and speeds."""

    seen: Observed
    subject_velocity: complex
    fence_centre: np.ndarray | None
    limits: Limits
    longest_m: float
    fastest_m_s: float

    def part(self, setpoint: Setpoint, along: float, across: float) -> tuple[Setpoint, Condition | None, bool]:
        """Part of a setpoint by its levels along and across the sight, its danger, whether its coast is too long."""
        seen = self.seen
        here, autopilot = seen.vehicle.position, seen.autopilot
        vectors = (setpoint.position - here, setpoint.velocity, setpoint.acceleration)
        way, velocity, acceleration = (
            _shared(vector, seen, *shares)
            for vector, *shares in zip(vectors, _shares(along), _shares(across), strict=True)
        )
        part = setpoint._replace(position=here + way, velocity=velocity, acceleration=acceleration)
        coast = autopilot.coast_of(part, here, seen.vehicle.velocity, _timeout_s(seen))
        return part, self.danger(coast), self.too_long(coast, part)

    def refined(self, setpoint: Setpoint, levels: tuple[float, float], above: tuple[float, float]) -> Setpoint:
        """The greatest harmless part between levels that are harmless and others above that are not."""
        least, greatest = np.array(levels), np.array(above)
        part = self.part(setpoint, *least)[0]
        for _ in range(_HALVINGS):
            middle = 0.5 * (least + greatest)
            more, danger, too_long = self.part(setpoint, *middle)
            if danger is None and not too_long:
                part, least = more, middle
            else:
                greatest = middle
        return part

    def danger(self, coast: Coast) -> Condition | None:
        """The limit that the coast breaks; None = none."""
        limits, place = self.limits, self.seen.subject.position
        speed = float(coast.speed_m_s.max())
        if speed > max(limits.orbit.max_speed_m_s, float(coast.speed_m_s[0]) + OWN_SPEED_SD_M_S):
            return condition(ConditionCode.COAST_UNSAFE, reach=f"reach {speed:.1f} m/s")
        if self.fence_centre is not None:
            away = np.abs(coast.place - complex(*self.fence_centre))
            if away.max() > max(limits.safety.fence_radius_m, float(away[0]) + _SLACK_M):
                fence_m = limits.safety.fence_radius_m
                return condition(ConditionCode.AT_FENCE, distance_m=float(away[0]), limit_m=fence_m)
        if place is None:
            return None
        subject, least = complex(*place[:2]), limits.orbit.min_distance_m
        walked = subject + self.subject_velocity * coast.time_s
        stands, walks = np.abs(coast.place - subject), np.abs(coast.place - walked)
        alone = float(np.abs(coast.place[0] - walked).min())  # of a vehicle that stands
        bounds = (
            (float(stands.min()), min(least, float(stands[0]) - _SLACK_M)),
            (float(walks.min()), max(min(least, alone - _SLACK_M), alone - _NEARER_M)),
        )
        near = min((distance for distance, limit in bounds if distance < limit), default=math.nan)
        return None if math.isnan(near) else condition(ConditionCode.COAST_UNSAFE, reach=f"come to {near:.1f} m")

    def too_long(self, coast: Coast, part: Setpoint) -> bool:
        """Whether the coast is too long, or comes too near by its creep, or the setpoint pulls too fast."""
        pulled = math.hypot(*_commanded(part, self.seen))
        return coast.length_m > self.longest_m or pulled > self.fastest_m_s or self._creep_m(coast) > _NEARER_M

    def _creep_m(self, coast: Coast) -> float:
        """Way (m) nearer, creep included, to a subject who moves as estimated; his own approach does not count."""
        if self.seen.subject.position is None:
            return 0.0
        now = complex(*self.seen.subject.position[:2])
        then = now + self.subject_velocity * float(coast.time_s[-1])
        alone = min(abs(coast.place[0] - now), abs(coast.place[0] - then))
        return float(alone - abs(coast.place[-1] - then) + coast.creep_towards(then))


def harmless(
    setpoint: Setpoint, seen: Observed, fence_centre: np.ndarray | None, limits: Limits
) -> tuple[Setpoint, Condition | None]:
    """The greatest part of the setpoint whose coast breaks no limit.

    Where no motion is harmless, the setpoint holds the present position, and the condition is why.

    The coast must be short, and stay inside the fence and the greatest speed.  It must stay clear of the minimum
    distance from a subject that stands and from one that moves as estimated, and come at most 1 m nearer to that one.
    What is taken away first: the way to the reference, because with less velocity the vehicle would fall behind it and
    the way would grow; then velocity and acceleration.  Across the line of sight first, where setpoints are held and
    about one who walks: a vehicle that falls behind along the orbit keeps its radius.  Where setpoints are continued,
    it would come near one who stands too fast as the radius shrinks.

    Parameters
    ----------
    fence_centre : (2,) m; None = there is no fence
    """
    held, velocity = not seen.autopilot.continues_setpoints, complex(*seen.subject.velocity[:2])
    longest_m, steady_m_s = seen.autopilot.coast.greatest * limits.safety.max_coast_m, coast_speed(seen, limits)
    fastest_m_s = steady_m_s + _PULLED * (steady_m_s + abs(velocity)) if held else math.inf
    judge = _Coasting(seen, velocity, fence_centre, limits, longest_m, fastest_m_s)
    across_first = seen.subject.position is not None and (held or abs(velocity) > WALKING_M_S)
    tries, problem = _TRIES_ACROSS_FIRST if across_first else _TRIES, None
    for i, (along, across) in enumerate(tries):
        part, problem, too_long = judge.part(setpoint, along, across)
        if problem is None and not too_long:
            between = held and along != tries[max(i - 1, 0)][0] and _retreats(setpoint, seen)
            return judge.refined(setpoint, tries[i], tries[i - 1]) if between else part, None
    # A coast that is only too long is not shorter after a hold: the slowest setpoint is sent.
    return part if problem is None else hold_setpoint(seen.vehicle.position, seen.vehicle.yaw), problem


def _shares(level: float) -> tuple[float, float, float]:
    """Shares of way, velocity and acceleration at a level: whole at 2, the velocity alone at 1, nothing at 0."""
    return max(level - 1.0, 0.0), min(level, 1.0), min(max(2.5 * level - 1.5, 0.0), 1.0)


def _shared(vector: np.ndarray, seen: Observed, along: float, across: float) -> np.ndarray:
    """Shares of a vector along the horizontal line of sight, and of the rest of it."""
    if seen.subject.position is None or along == across:
        return along * vector
    sight = np.append((seen.subject.position - seen.vehicle.position)[:2], 0.0)
    part = (vector @ sight) / max(float(sight @ sight), 0.01) * sight
    shared: np.ndarray = across * vector + (along - across) * part
    return shared


def _commanded(setpoint: Setpoint, seen: Observed) -> np.ndarray:
    """(2,) m/s that the autopilot commands: of the setpoint, and of the way to its place."""
    way = setpoint.position - seen.vehicle.position
    commanded: np.ndarray = (setpoint.velocity + seen.autopilot.position_gain_per_s * way)[:2]
    return commanded


def _retreats(setpoint: Setpoint, seen: Observed) -> bool:
    """Whether the vehicle is to fly away from the subject."""
    place = seen.subject.position
    return place is not None and float(_commanded(setpoint, seen) @ (place - seen.vehicle.position)[:2]) < 0.0


def _timeout_s(seen: Observed) -> float:
    return seen.autopilot.timeout_s(seen.loss_settings)


# -- the closing speed ------------------------------------------------------------------------------------------------


class _Closing(NamedTuple):
    """What bounds the speed towards the subject.

    overshoot : share of the greatest closing speed that a setpoint has: the vehicle overshoots
    surely_m_s : so much faster than by the estimated place he may recede by his image, which shrinks as he bends
    far_error_m_s : that his receding must exceed far away: from 12 m one who stands recedes at up to 0.4 m/s
    step_m_s : most that a setpoint adds to the present closing speed towards one who stands, where setpoints are
        continued: the vehicle overshoots a larger step
    stops : share of the speed at which such a vehicle follows a walker, by which it closes up more slowly: a stop is
        seen 0.4 s late
    """

    overshoot: float = 0.85
    surely_m_s: float = 0.1
    far_error_m_s: float = 0.3
    step_m_s: float = 0.4
    stops: float = 0.3


_CLOSING = _Closing()


def limit_closing(setpoint: Setpoint, seen: Observed, limits: Limits) -> Setpoint:
    """The setpoint with no more speed towards the subject than his size allows."""
    sight, orbit = seen.subject.by_size, limits.orbit
    if sight is None:
        return setpoint
    room = math.sqrt(2 * limits.safety.braking_m_s2 * max(sight.nearest_m - orbit.min_distance_m, 0.0))
    receding = min(sight.receding_m_s, max(-seen.subject.approach_m_s, 0.0) + _CLOSING.surely_m_s)
    receding = min(receding, max(receding - farness(sight.distance_m) * _CLOSING.far_error_m_s, 0.0))
    closing_up = _CLOSING.overshoot * orbit.max_closing_m_s
    allowed = min(max(closing_up + receding, 0.0), room)
    if seen.autopilot.continues_setpoints:
        closing = float(seen.vehicle.velocity[:2] @ sight.toward)
        allowed -= _CLOSING.stops * min(max(receding, 0.0), closing_up)
        # Its path, limited in jerk, overshoots a reversal: from 1.8 m/s away it closed up at 1.3 m/s without this.
        allowed += min(closing, 0.0)
        allowed = max(min(allowed, max(closing, 0.0) + _CLOSING.step_m_s + receding), 0.0)
    return _bounded(setpoint, seen, sight, allowed, orbit.max_acceleration_m_s2)


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


# -- what a vehicle behind a walker lacks -----------------------------------------------------------------------------

_RATE_PER_S2 = 0.8  # of the missing velocity
_FORGETTING_PER_S = 0.1  # of what was missing: gusts pass
_MOST_M_S2 = 0.6  # that is added behind one who walks, 1 m/s faster than one seems to who stands: he needs none


class Shortfall:
    """Integral of the commanded velocity that the vehicle does not reach; it reads no clock."""

    def __init__(self) -> None:
        self._integral: np.ndarray = np.zeros(2)  # m/s^2 ENU

    def added(self, setpoint: Setpoint, seen: Observed, subject_velocity: np.ndarray) -> Setpoint:
        """The setpoint with the missing acceleration along the line of sight.

        subject_velocity : (2,) m/s, smoothed
        """
        subject = seen.subject.position
        if seen.autopilot.continues_setpoints or subject is None:
            return setpoint
        sight = subject[:2] - seen.vehicle.position[:2]
        toward = sight / max(float(np.hypot(*sight)), 0.5)
        speed = float(np.hypot(*subject_velocity))
        most = _MOST_M_S2 * min(max(speed - STANDING_M_S, 0.0), 1.0)
        along = min(max(float(self._integral @ toward), -most), most)
        return setpoint._replace(acceleration=setpoint.acceleration + np.append(along * toward, 0.0))

    def learn(self, sent: Setpoint, seen: Observed, dt: float) -> None:
        """Take the setpoint that was sent, ``dt`` s after the one before."""
        wanted = sent.velocity + seen.autopilot.position_gain_per_s * (sent.position - seen.vehicle.position)
        missing = (wanted - seen.vehicle.velocity)[:2]
        dt = min(max(dt, 0.0), 0.2)
        self._integral = self._integral + (_RATE_PER_S2 * missing - _FORGETTING_PER_S * self._integral) * dt
        size = math.hypot(*self._integral)
        self._integral = self._integral * min(1.0, 1.0 / max(size, 1e-9))  # m/s^2 at most
