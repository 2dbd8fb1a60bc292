"""Observations of a healthy flight, and an orbit that begins with them."""

import dataclasses
import math

import numpy as np

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, Command, Limits, Observed, SafetyState, State
from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.safety_config import SafetyConfig

LIMITS = Limits(SafetyConfig(commands_enabled=True, mode_change_allowed=True), OrbitConfig())
GOOD = Observed(
    autopilot="ardupilot", mode="GUIDED", in_control=True, armed=True, landed_state=2, link_age_s=0.02,
    heartbeat_age_s=0.05, state_age_s=0.05, position_age_s=0.05, status_age_s=0.2, round_trip_s=0.02,
    gps_fix_type=3, position_ok=True, battery_fraction=0.8, position=np.array([6.0, 0, 2.5]), velocity=np.zeros(3),
    yaw=math.pi, height_m=2.5, subject=np.zeros(3), subject_age_s=0.1, subject_sd_m=0.5, subject_distance_m=6.0,
)  # fmt: skip
LOITER = dataclasses.replace(GOOD, mode="LOITER", in_control=False)
BRAKE = dataclasses.replace(GOOD, mode="BRAKE", in_control=False, in_hold=True)


def orbiting(seen=GOOD):
    state, _ = reduce(SafetyState(), seen, 0.0, None, LIMITS)
    assert state.state == State.READY
    state, decision = reduce(state, seen, 0.1, Command.START, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    assert (decision.answer.accepted, decision.answer.condition.code) == (True, ConditionCode.ORBITING)
    return state
