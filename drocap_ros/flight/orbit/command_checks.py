"""Validation of the operator's commands on entry: what they ask, and when they were given."""

from __future__ import annotations

import math

from drocap_ros.flight.bridge_config import FENCE_ROOM_M, MavlinkBridgeConfig
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.flight.orbit.planner import OrbitGoal, goal_of
from drocap_ros.flight.orbit.states import Command, OperatorCommand
from drocap_ros.flight.orbit_config import orbit_condition
from drocap_ros.flight.safety_config import height_condition
from drocap_ros.flight.subject.framing import Framing

_NS = 1_000_000_000
_COMMAND_AGE_S = 2.0


def command_condition(command: OperatorCommand, now_ns: int) -> Condition | None:
    """Why a command is refused whatever the state: an unknown number, or a stamp too far from now."""
    if command.kind not in list(Command):
        return condition(ConditionCode.UNKNOWN_COMMAND, number=command.kind)
    age_s = (now_ns - command.stamp_ns) / _NS
    if command.stamp_ns and abs(age_s) > _COMMAND_AGE_S:
        return condition(ConditionCode.COMMAND_OUTDATED, age_s=age_s, limit_s=_COMMAND_AGE_S)
    return None


def commanded_goal(
    config: MavlinkBridgeConfig, command: OperatorCommand, present: OrbitGoal | None, framing: Framing | None = None
) -> OrbitGoal | Condition:
    """The goal that a command asks for, or why the limits forbid it.

    present : values that a NaN keeps; None = the configured ones
    framing : of a camera that does not follow the person, who must stay in the picture
    """
    for name in ("radius_m", "height_m", "angular_speed_deg_s"):
        if math.isinf(value := getattr(command, name)):
            return condition(ConditionCode.VALUE_NOT_FINITE, name=name, value=value)
    goal = goal_of(config, command.radius_m, command.height_m, command.angular_speed_deg_s, present)
    speed = math.degrees(goal.angular_speed_rad_s)
    beyond = orbit_condition(config, goal.radius_m, speed) or height_condition(config, goal.height_m)
    widest_m = config.fence_radius_m - FENCE_ROOM_M
    if beyond is None and goal.radius_m > widest_m * ROUNDING:
        fence = "fence_radius_m less 1 m of room"
        beyond = condition(ConditionCode.RADIUS_TOO_LARGE, value=goal.radius_m, limit=widest_m, limited_by=fence)
    return beyond or (framing.refusal(goal) if framing else None) or goal
