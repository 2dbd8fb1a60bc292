"""Observations of a healthy flight, and an orbit that begins with them."""

import dataclasses
import math

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.observed import Course, Health, Height, Link, Mode, Motion, Observed, Pictures, Subject
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, Command, Idle, State

LIMITS = MavlinkBridgeConfig(commands_enabled=True, mode_change_allowed=True, max_control_timeout_s=0.0)
#: Parts of an observation and fields of theirs by short names, with which :func:`changed` sets them.
FIELDS = {
    "mode": ("mode", "name"),
    "link_age_s": ("link", "age_s"),
    "status_age_s": ("health", "age_s"),
    "state_age_s": ("vehicle", "age_s"),
    "subject": ("subject", "position"),
    "subject_age_s": ("subject", "age_s"),
    "subject_contradicted": ("subject", "contradicted"),
    "subject_sd_m": ("subject", "sd_m"),
    "subject_distance_m": ("subject", "distance_m"),
    "subject_velocity": ("subject", "velocity"),
    "picture_age_s": ("pictures", "age_s"),
}
for _part in (Mode, Link, Health, Motion, Subject, Pictures, Course):
    _name = {Motion: "vehicle"}.get(_part, _part.__name__.lower())
    for _field in dataclasses.fields(_part):
        if not (_field.name in ("name", "age_s", "position", "velocity") and _part is not Motion):
            FIELDS.setdefault(_field.name, (_name, _field.name))


def changed(seen, **values):
    """The observation with other values of its own fields or, by the names of ``FIELDS``, of those of its parts."""
    parts = {}
    if "autopilot" in values:
        values |= {"autopilot": autopilot_of(values["autopilot"]), "autopilot_name": values["autopilot"]}
    if "height_m" in values:
        values["height"] = Height(values.pop("height_m"), 0.5)
    for name, value in values.items():
        if name in FIELDS:
            part, field = FIELDS[name]
            parts.setdefault(part, {})[field] = value
        else:
            parts[name] = value
    return dataclasses.replace(
        seen,
        **{
            name: dataclasses.replace(getattr(seen, name), **value) if isinstance(value, dict) else value
            for name, value in parts.items()
        },
    )


GOOD = changed(
    Observed(),
    autopilot="ardupilot", mode="GUIDED", in_control=True, armed=True, landed_state=2, link_age_s=0.02,
    heartbeat_age_s=0.05, state_age_s=0.05, position_age_s=0.05, status_age_s=0.2, round_trip_s=0.02,
    gps_fix_type=3, position_ok=True, battery_fraction=0.8, position=np.array([6.0, 0, 2.5]), velocity=np.zeros(3),
    yaw=math.pi, height_m=2.5, subject=np.zeros(3), subject_age_s=0.1, subject_sd_m=0.5, subject_distance_m=6.0,
    picture_age_s=0.1, silent_s=0.05,
)  # fmt: skip
LOITER = changed(GOOD, mode="LOITER", in_control=False)
BRAKE = changed(GOOD, mode="BRAKE", in_control=False, in_hold=True)


def orbiting(seen=GOOD):
    state, _ = reduce(Idle(), seen, 0.0, None, LIMITS)
    assert state.state == State.READY
    state, decision = reduce(state, seen, 0.1, Command.START, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    assert (decision.answer.accepted, decision.answer.condition.code) == (True, ConditionCode.ORBITING)
    return state
