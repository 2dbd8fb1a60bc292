"""Outcome of one step of the control loop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.flight.bridge_config import WORTH_TELLING, MavlinkBridgeConfig, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.orbit.planner import OrbitState
from drocap_ros.flight.orbit.states import Action, CommandAnswer, OperatorCommand, State

_CLEAR = (
    "clear of min_distance_m, {:g} m, if the range is wrong; size_error, {:g}, may be 0.04 where body_height_m is the"
    " subject's"
)
_FRAMED = (
    "there the fixed camera keeps one in the picture who walks up to the vehicle; a wider lens or a gimbal keeps him"
    " nearer"
)


class ControlStatus(NamedTuple):
    """Outcome of one step: the fields of ``msg/OrbitStatus.msg``, the commands it answered, and what was sent.

    failed : why the last engage ended without an orbit; None = it did not, or another command has followed
    mode_failure : why the autopilot did not enter the requested mode, as a sentence; "" = it did, or none was requested
    way_out : what the operator may do next, as a sentence; "" = nothing
    """

    state: State
    condition: Condition
    failed: Condition | None
    mode_failure: str
    way_out: str
    answers: list[tuple[OperatorCommand, CommandAnswer]]
    radius_m: float
    height_m: float
    angular_speed_deg_s: float
    radius_error_m: float
    yaw_error_deg: float
    subject_position: np.ndarray
    action: Action

    @property
    def reason(self) -> str:
        """Why the controller is in its state, and what leads out of it, as a sentence."""
        failed = "" if self.failed in (None, self.condition) else str(self.failed)
        present = f"{self.condition} ({self.mode_failure})" if self.mode_failure else str(self.condition)
        return "; ".join(filter(None, (present, failed, self.way_out)))


def widened_condition(
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
