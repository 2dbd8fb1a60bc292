"""The setpoint of a step, in three functions: planned, limited, sent.

:meth:`FlownOrbit.planned` is the setpoint of the reference; :meth:`FlownOrbit.limited` slows it down (``speed.py``),
and adds what a vehicle behind a walking subject lacks; :func:`harmless` takes away what would break a limit if nothing
followed.  After the death of the bridge the autopilot flies the last setpoint until its time-out, and then stops by
itself; how it does (time-out, deceleration, gain) is a matter of its object.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.coasting import Coast, Setpoint, hold_setpoint
from drocap_ros.flight.bridge_config import HEIGHT_ROOM_M, WORTH_TELLING, MavlinkBridgeConfig, OrbitGoal, goal_of
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.command_checks import Order
from drocap_ros.flight.orbit.motion_checks import OWN_SPEED_SD_M_S
from drocap_ros.flight.orbit.planner import (
    OrbitState,
    Scene,
    advance,
    begin_orbit,
    least_radius,
    reference_position,
    setpoint_of,
)
from drocap_ros.flight.orbit.speed import coast_speed, limit_closing, slowed, slowed_condition, timeout_s
from drocap_ros.flight.orbit.states import Orbiting, Pace
from drocap_ros.flight.subject.framing import Framing
from drocap_ros.flight.subject.subject_filter import STANDING_M_S, WALKING_M_S

_CLEAR = (
    "clear of min_distance_m, {:g} m, if the range is wrong; size_error, {:g}, may be 0.04 where body_height_m is the"
    " subject's"
)
_FRAMED = (
    "there the fixed camera keeps one in the picture who walks up to the vehicle; a wider lens or a gimbal keeps him"
    " nearer"
)
_LEAST_SD_M = 0.05  # of a height
#: m; no coast, the creep after its stop included, brings the vehicle by more nearer to the subject: 1 m is required of
#: the bridge's death (benchmarks/flight_kills.py), and the prediction errs.
_NEARER_M = 0.9
_SLACK_M = 0.2  # what the vehicle has already is no effect of the setpoint
#: Levels that are tried, one after the other, see :func:`_shares`: of the setpoint's part along and of that across the
#: line of sight, both at once or the one across first.  A step is a fifth of the speed, a quarter or half of the way.
_LEVELS = (2.0, 1.5, 1.0, 0.8, 0.6, 0.4, 0.2)
_TRIES = [(level, level) for level in _LEVELS]
_TRIES_ACROSS_FIRST = [(2.0, across) for across in (2.0, 1.75, 1.5, 1.25, 1.0, 0.8, 0.6, 0.4)]
_TRIES_ACROSS_FIRST += [(level, min(level, 0.4)) for level in _LEVELS[1:]]


class FlownOrbit:
    """The orbit and its setpoints.

    goal : of the last accepted command
    unsafe : why the last setpoint was not sent; None = it was
    """

    def __init__(self, config: MavlinkBridgeConfig) -> None:
        self._config = config
        self.goal: OrbitGoal = goal_of(config)
        self.unsafe: Condition | None = None
        self._reference: OrbitState | None = None
        self._shortfall = Shortfall()
        self._framed_radius_m = 0.0

    @property
    def place(self) -> np.ndarray | None:
        """(3,) m ENU, place of the vehicle on the orbit; None = no orbit is flown."""
        return None if self._reference is None else reference_position(self._reference)

    def take(self, order: Order) -> None:
        """Take an accepted order's goal."""
        if order.goal is not None:
            self.goal = order.goal

    def begin(self, seen: Observed) -> None:
        """Begin an orbit where the vehicle is."""
        assert seen.subject.position is not None
        vehicle = seen.vehicle
        self._shortfall = Shortfall()
        self._reference = begin_orbit(vehicle.position, seen.subject.position, self._config)

    def end(self) -> None:
        """No orbit is flown."""
        self._reference = self.unsafe = None

    def setpoint(self, seen: Observed, safety: Orbiting, framing: Framing, dt: float) -> Setpoint | None:
        """The setpoint of this step, ``dt`` s after the last one; None where no orbit is flown."""
        if self._reference is None or seen.subject.position is None:
            return None
        planned = self.planned(self._reference, seen, framing, dt * safety.pace.value)
        sent, self.unsafe = harmless(self.limited(planned, seen, safety.pace), seen, safety.fence_centre, self._config)
        self._shortfall.learn(sent, seen, dt)
        return sent

    def planned(self, reference: OrbitState, seen: Observed, framing: Framing, dt: float) -> Setpoint:
        """The setpoint of the reference ``dt`` s of its time later."""
        scene = self._scene(seen, framing)
        self._reference = advance(reference, self.goal, scene, dt, self._config)
        planned = setpoint_of(self._reference, scene, self._config)
        return planned._replace(yaw=planned.yaw + seen.subject.heading_error)  # the autopilot flies by its own heading

    def limited(self, planned: Setpoint, seen: Observed, pace: Pace) -> Setpoint:
        """The setpoint at this pace, with what a vehicle behind a walker lacks, bounded towards the subject."""
        assert self._reference is not None
        pushed = self._shortfall.added(planned, seen, self._reference.centre_velocity)
        return limit_closing(slowed(pushed, pace, self._config.max_acceleration_m_s2), seen, self._config)

    def flown_condition(self, present: Condition, seen: Observed) -> Condition:
        """The condition of the machine, with the radius and the speed that are flown where these are not the goal's."""
        if self._reference is None:
            return present
        widened, goal = _widened_condition(present, self.goal, self._reference, self._framed_radius_m, self._config)
        return slowed_condition(widened, goal, seen, self._config)

    def _scene(self, seen: Observed, framing: Framing) -> Scene:
        subject, config = seen.subject, self._config
        assert subject.position is not None
        speed = float(np.hypot(*subject.velocity[:2]))
        least = least_radius(
            config, subject.sd_m, speed, config.braking_m_s2, config.size_error, subject.nearer * subject.distance_m
        )
        self._framed_radius_m = framing.least_radius(self.goal, speed, seen.autopilot.gives_way_s)
        return Scene(
            vehicle=seen.vehicle.position,
            subject=subject.position,
            subject_velocity=subject.velocity,
            ground_m=config.ground_height_m + self._risen_m(seen),
            least_radius_m=max(least, self._framed_radius_m),
            greatest_speed_m_s=coast_speed(seen, self._config),
        )

    def _risen_m(self, seen: Observed) -> float:
        """By how much (m) the vehicle is lower above the subject's ground than reported: one never flies lower.

        The mean of all heights counts by their variances; the lowest one keeps clear of the limit by itself.
        """
        config, goal_m, heights = self._config, self.goal.height_m, seen.heights.values()
        metres, weights = np.array([h.m for h in heights]), np.array([max(h.sd_m, _LEAST_SD_M) ** -2 for h in heights])
        reported, least_m = seen.vehicle.height.m, config.min_height_m + HEIGHT_ROOM_M[0]
        lower = reported - float(weights @ metres / weights.sum())
        lowest = reported - float(metres.min()) + least_m - goal_m
        return min(max(lower, lowest, 0.0), max(config.max_height_m - HEIGHT_ROOM_M[1] - goal_m, 0.0))


def _widened_condition(
    present: Condition, goal: OrbitGoal, orbit: OrbitState, framed_radius_m: float, config: MavlinkBridgeConfig
) -> tuple[Condition, OrbitGoal]:
    """The condition of a flown orbit, with its radius if that is wider than the goal's, and the goal that is flown.

    framed_radius_m : least radius at which one who walks stays in the picture
    """
    if present.code != ConditionCode.ORBITING or orbit.goal_radius <= (1.0 + WORTH_TELLING) * goal.radius_m:
        return present, goal
    why = _FRAMED if orbit.goal_radius <= framed_radius_m else _CLEAR.format(config.min_distance_m, config.size_error)
    widened = condition(
        ConditionCode.WIDENED, cause=present, radius_m=orbit.goal_radius, wanted_m=goal.radius_m, why=why
    )
    return widened, goal._replace(radius_m=orbit.goal_radius)


class _Coasting(NamedTuple):
    """What the coast of a part of the setpoint is judged by: the subject's velocity, the fence, lengths and speeds."""

    seen: Observed
    subject_velocity: complex
    fence_centre: np.ndarray | None
    config: MavlinkBridgeConfig
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
        coast = autopilot.coast_of(part, here, seen.vehicle.velocity, timeout_s(seen))
        return part, self.danger(coast), self.too_long(coast, part)

    def refined(self, setpoint: Setpoint, levels: tuple[float, float], above: tuple[float, float]) -> Setpoint:
        """The greatest harmless part between levels that are harmless and others above that are not."""
        least, greatest = np.array(levels), np.array(above)
        part = self.part(setpoint, *least)[0]
        # Finer than an eighth, a vehicle that holds setpoints retreats no more slowly.
        for _ in range(3):
            middle = 0.5 * (least + greatest)
            more, danger, too_long = self.part(setpoint, *middle)
            if danger is None and not too_long:
                part, least = more, middle
            else:
                greatest = middle
        return part

    def danger(self, coast: Coast) -> Condition | None:
        """The limit that the coast breaks; None = none."""
        config, place = self.config, self.seen.subject.position
        speed = float(coast.speed_m_s.max())
        if speed > max(config.max_speed_m_s, float(coast.speed_m_s[0]) + OWN_SPEED_SD_M_S):
            return condition(ConditionCode.COAST_UNSAFE, reach=f"reach {speed:.1f} m/s")
        if self.fence_centre is not None:
            away = np.abs(coast.place - complex(*self.fence_centre))
            if away.max() > max(config.fence_radius_m, float(away[0]) + _SLACK_M):
                fence_m = config.fence_radius_m
                return condition(ConditionCode.AT_FENCE, distance_m=float(away[0]), limit_m=fence_m)
        if place is None:
            return None
        subject, least = complex(*place[:2]), config.min_distance_m
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
    setpoint: Setpoint, seen: Observed, fence_centre: np.ndarray | None, config: MavlinkBridgeConfig
) -> tuple[Setpoint, Condition | None]:
    """The greatest part of the setpoint whose coast breaks no limit.

    Where no motion is harmless, the setpoint holds the present position, and the condition is why.

    The coast must be short, and stay inside the fence and the greatest speed.  It must stay clear of the minimum
    distance from a subject that stands and from one that moves as estimated, and come at most 1 m nearer to that one.
    What is taken away first: the way to the reference, because with less velocity the vehicle would fall behind it and
    the way would grow; then velocity and acceleration.  Across the line of sight first, where setpoints are held and
    about one who walks: a vehicle that falls behind along the orbit keeps its radius.  Where setpoints are continued,
    it would come near one who stands too fast as the radius shrinks.

    fence_centre : (2,) m; None = there is no fence
    """
    held, velocity = not seen.autopilot.continues_setpoints, complex(*seen.subject.velocity[:2])
    longest_m, steady_m_s = seen.autopilot.greatest_coast * config.max_coast_m, coast_speed(seen, config)
    # Setpoint and way together may ask more by a quarter of a steady flight's and of the subject's speed.  A far place
    # lets a vehicle that holds setpoints fly faster than predicted: behind a walker it went on for 3.1 m.
    fastest_m_s = steady_m_s + 0.25 * (steady_m_s + abs(velocity)) if held else math.inf
    judge = _Coasting(seen, velocity, fence_centre, config, longest_m, fastest_m_s)
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
        # Whole behind one who walks 1 m/s faster than one seems to who stands: he needs none.
        most = 0.6 * min(max(speed - STANDING_M_S, 0.0), 1.0)
        along = min(max(float(self._integral @ toward), -most), most)
        return setpoint._replace(acceleration=setpoint.acceleration + np.append(along * toward, 0.0))

    def learn(self, sent: Setpoint, seen: Observed, dt: float) -> None:
        """Take the setpoint that was sent, ``dt`` s after the one before."""
        wanted = sent.velocity + seen.autopilot.position_gain_per_s * (sent.position - seen.vehicle.position)
        missing = (wanted - seen.vehicle.velocity)[:2]
        dt = min(max(dt, 0.0), 0.2)
        # What was missing is forgotten in 10 s: gusts pass.
        self._integral = self._integral + (0.8 * missing - 0.1 * self._integral) * dt
        size = math.hypot(*self._integral)
        self._integral = self._integral * min(1.0, 1.0 / max(size, 1e-9))  # m/s^2 at most
