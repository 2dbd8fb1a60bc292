"""The orbit while it is flown: its goal, its reference, and the one pass that makes the setpoint of a step."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.autopilot.setpoint import Setpoint
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.command_checks import Order, commanded_goal
from drocap_ros.flight.orbit.control_status import widened_condition
from drocap_ros.flight.orbit.degradation import slowed
from drocap_ros.flight.orbit.last_setpoint import Shortfall, coast_speed, harmless, limit_closing, slowed_condition
from drocap_ros.flight.orbit.planner import (
    OrbitState,
    Scene,
    advance,
    begin_orbit,
    least_radius,
    reference_position,
    setpoint_of,
)
from drocap_ros.flight.orbit.states import Command, Limits, OperatorCommand, SafetyState
from drocap_ros.flight.orbit.view_plan import Reach, planned_goal, reach_of
from drocap_ros.flight.orbit_config import ACCURACY
from drocap_ros.flight.orbit_goal import OrbitGoal, Wish, goal_of
from drocap_ros.flight.safety_config import HEIGHT_ROOM_M
from drocap_ros.flight.subject.framing import Framing

_SURE_SIZES = 3.0  # of size_error, beyond which the picture contradicts the height
NO_POSES = "no forecast of the views (pose3d/views: poses in map) has come"
NO_NEWER = "no newer forecast of the views (pose3d/views: poses in map) comes"
_FLOWN = (ConditionCode.ORBITING, ConditionCode.WIDENED, ConditionCode.SLOWED)


class FlownOrbit:
    """The orbit and its setpoints.

    goal : of the last accepted command
    plan : by which height and angular speed are chosen, one of ``PLANS``
    wish : the newest one of the plan, or why there is none
    unsafe : why the last setpoint was not sent; None = it was
    """

    def __init__(self, config: MavlinkBridgeConfig, limits: Limits) -> None:
        self._config, self._limits = config, limits
        self.goal: OrbitGoal = goal_of(config)
        self.plan = config.plan
        self.wish: Wish | str = NO_POSES
        self._flown, self._unplanned = self.goal, ""
        self.unsafe: Condition | None = None
        self._reference: OrbitState | None = None
        self._shortfall = Shortfall()
        self._framed_radius_m = self._greatest_m_s = 0.0

    @property
    def place(self) -> np.ndarray | None:
        """(3,) m ENU, place of the vehicle on the orbit; None = no orbit is flown."""
        return None if self._reference is None else reference_position(self._reference)

    def take(self, order: Order) -> None:
        """Take an accepted order's goal and plan."""
        if order.goal is not None:
            self.goal = order.goal
            self.plan = order.command.plan or (self.plan if order.kind == Command.ADJUST else self._config.plan)

    def choose(self, framing: Framing, now_s: float) -> None:
        """Choose what is flown now: the goal, or with a plan its wish, judged as an operator who adjusts the goal."""
        self._flown, self._unplanned = self.goal, ""
        if self.plan != ACCURACY:
            return
        wish = self.wish
        if isinstance(wish, str) or wish.until_s < now_s:
            self._unplanned = wish if isinstance(wish, str) else NO_NEWER
            return
        wished = planned_goal(self.goal, wish, self._reference) if self._reference else self.goal
        adjust = OperatorCommand(int(Command.ADJUST), *wished[:2], math.degrees(wished.angular_speed_rad_s))
        judged = commanded_goal(self._config, adjust, self.goal, framing)
        if isinstance(judged, Condition):
            self._unplanned = str(judged)
        else:
            self._flown = judged

    def planned_from(self, now_s: float) -> tuple[tuple[float, float], Reach, Wish | None] | None:
        """What ``choose_view`` begins from: place, reach and present wish; None = there is nothing to plan."""
        if self._reference is None or self.plan != ACCURACY:
            return None
        config, reference = self._config, self._reference
        reach = reach_of(config, self.goal, reference.radius.value, self._greatest_m_s)
        place = (reference.phase, reference.height.value - config.ground_height_m)
        former = self.wish if isinstance(self.wish, Wish) and self.wish.until_s > now_s else None
        return place, reach, former

    def begin(self, seen: Observed) -> None:
        """Begin an orbit where the vehicle is."""
        assert seen.subject.position is not None
        vehicle = seen.vehicle
        self._shortfall = Shortfall()
        self._reference = begin_orbit(vehicle.position, seen.subject.position, self._config)

    def end(self) -> None:
        """No orbit is flown."""
        self._reference = self.unsafe = None

    def setpoint(self, seen: Observed, safety: SafetyState, framing: Framing, dt: float) -> Setpoint | None:
        """The setpoint of this step, ``dt`` s after the last one; None where no orbit is flown."""
        if self._reference is None or seen.subject.position is None:
            return None
        config, limits, pace = self._config, self._limits, safety.pace
        scene = self._scene(seen, framing)
        reference = self._reference = advance(self._reference, self._flown, scene, dt * pace.value, config)
        planned = setpoint_of(reference, scene, config)
        pushed = self._shortfall.added(planned, seen, reference.centre_velocity)
        paced = slowed(pushed, pace, config.max_acceleration_m_s2)
        clear = limit_closing(paced, seen, limits)
        sent, self.unsafe = harmless(clear, seen, safety.fence_centre, limits)
        self._shortfall.learn(sent, seen, dt)
        return sent

    def flown_condition(self, present: Condition, seen: Observed) -> Condition:
        """The condition of the machine, with the radius and the speed that are flown where these are not the goal's."""
        if self._reference is None:
            return present
        widened, goal = widened_condition(present, self._flown, self._reference, self._framed_radius_m, self._config)
        slower = slowed_condition(widened, goal, seen, self._limits)
        if self.plan != ACCURACY or slower.code not in _FLOWN:
            return slower
        if self._unplanned:
            return condition(ConditionCode.UNPLANNED, cause=slower, why=self._unplanned)
        return condition(
            ConditionCode.PLANNED,
            cause=slower,
            speed_deg_s=math.degrees(self._flown.angular_speed_rad_s),
            height_m=self._flown.height_m,
            why=self.wish.why if isinstance(self.wish, Wish) else "",
        )

    def _scene(self, seen: Observed, framing: Framing) -> Scene:
        subject, config = seen.subject, self._config
        assert subject.position is not None
        speed = float(np.hypot(*subject.velocity[:2]))
        least = least_radius(
            config, subject.sd_m, speed, config.braking_m_s2, config.size_error, subject.nearer * subject.distance_m
        )
        self._framed_radius_m = framing.least_radius(self._flown, speed, seen.autopilot.gives_way_s)
        self._greatest_m_s = coast_speed(seen, self._limits)
        return Scene(
            vehicle=seen.vehicle.position,
            subject=subject.position,
            subject_velocity=subject.velocity,
            ground_m=config.ground_height_m + self._risen_m(seen),
            least_radius_m=max(least, self._framed_radius_m),
            greatest_speed_m_s=self._greatest_m_s,
        )

    def _risen_m(self, seen: Observed) -> float:
        """By how much (m) the subject's ground is surely higher below the vehicle than assumed: one never flies lower.

        The range by the ground is too long in proportion where the reported height is too great, or the ground rises.
        """
        config, height_m = self._config, seen.vehicle.height_m
        lower = (1.0 - _SURE_SIZES * config.size_error - seen.subject.size_over_ground) * height_m
        room_m = config.max_height_m - HEIGHT_ROOM_M[1] - self._flown.height_m
        return min(lower, max(room_m, 0.0)) if lower > 0.0 else 0.0  # NaN is not
