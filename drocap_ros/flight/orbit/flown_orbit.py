"""The orbit while it is flown: its goal, its reference, and the one pass that makes the setpoint of a step."""

from __future__ import annotations

import numpy as np

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.bridge_config import HEIGHT_ROOM_M, MavlinkBridgeConfig, OrbitGoal, goal_of
from drocap_ros.flight.conditions import Condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.command_checks import Order
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
from drocap_ros.flight.orbit.states import Limits, Orbiting
from drocap_ros.flight.subject.framing import Framing

_SURE_SIZES = 3.0  # of size_error, beyond which the picture contradicts the height


class FlownOrbit:
    """The orbit and its setpoints.

    goal : of the last accepted command
    unsafe : why the last setpoint was not sent; None = it was
    """

    def __init__(self, config: MavlinkBridgeConfig, limits: Limits) -> None:
        self._config, self._limits = config, limits
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
        config, limits, pace = self._config, self._limits, safety.pace
        scene = self._scene(seen, framing)
        reference = self._reference = advance(self._reference, self.goal, scene, dt * pace.value, config)
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
        widened, goal = widened_condition(present, self.goal, self._reference, self._framed_radius_m, self._config)
        return slowed_condition(widened, goal, seen, self._limits)

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
            greatest_speed_m_s=coast_speed(seen, self._limits),
        )

    def _risen_m(self, seen: Observed) -> float:
        """By how much (m) the subject's ground is surely higher below the vehicle than assumed: one never flies lower.

        The range by the ground is too long in proportion where the reported height is too great, or the ground rises.
        """
        config, height_m = self._config, seen.vehicle.height_m
        lower = (1.0 - _SURE_SIZES * config.size_error - seen.subject.size_over_ground) * height_m
        room_m = config.max_height_m - HEIGHT_ROOM_M[1] - self.goal.height_m
        return min(lower, max(room_m, 0.0)) if lower > 0.0 else 0.0  # NaN is not
