import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.telemetry_request import AutopilotSettings
from drocap_ros.flight.orbit.motion_checks import loss_condition
from drocap_ros.flight.orbit.states import Action, State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

MAV = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
REAL, INTEGER = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32


def settings(autopilot, **values):
    known = AutopilotSettings()
    known.set_autopilot(autopilot_of(autopilot))
    for name, value in values.items():
        kind = INTEGER if isinstance(value, int) else REAL
        raw = value * 2.0**-149 if isinstance(value, int) else value  # the integer's bytes, read as a float
        (message,) = mavlink.MAVLink(None).parse_buffer(
            MAV.param_value_encode(name.encode(), raw, kind, 9, 0).pack(MAV)
        )
        known.take(message)
    return known


@pytest.mark.parametrize(
    ("autopilot", "values", "code"),
    [
        ("ardupilot", {}, ConditionCode.TIMEOUT_UNKNOWN),
        ("ardupilot", {"GUID_TIMEOUT": math.nan}, ConditionCode.TIMEOUT_UNKNOWN),
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, ConditionCode.TIMEOUT_TOO_LONG),
        ("ardupilot", {"GUID_TIMEOUT": 0.5}, None),
        ("px4", {"COM_OBL_RC_ACT": 5}, ConditionCode.TIMEOUT_UNKNOWN),
        ("px4", {"COM_OF_LOSS_T": 1.0}, ConditionCode.TIMEOUT_TOO_LONG),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 7}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 6}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 0}, ConditionCode.LOSS_ACTION_FATAL),  # as it ships
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 1}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 2}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5}, ConditionCode.LOSS_ACTION_FATAL),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 3}, None),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 4}, None),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5}, None),
        ("other", {}, None),
    ],
)
def test_settings_that_forbid_motion(autopilot, values, code):
    known = settings(autopilot, **values).loss_settings()
    meaning = autopilot_of(autopilot).loss_action
    found = loss_condition(known, meaning, 0.5)
    assert (found and found.code) == code
    assert loss_condition(known, meaning, 0.0) is None
    if code == ConditionCode.LOSS_ACTION_FATAL:
        assert "set COM_OBL_RC_ACT to 5, hold" in str(found)
    if code == ConditionCode.TIMEOUT_TOO_LONG:
        assert f"set {known.timeout_name} to 0.5" in str(found)


def test_leaving_without_setpoints_is_a_warning():
    assert "lands" in settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=4).warning()
    assert "home" in settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=3).warning()
    assert settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=5).warning() == ""
    assert settings("ardupilot", GUID_TIMEOUT=0.5).warning() == ""


def test_settings_are_requested_until_reported_and_then_rarely():
    known = settings("ardupilot")
    asked = [t for t in range(0, 60_000, 10) if known.due(t / 1000)]
    assert len([t for t in asked if t < 7000]) == 10
    assert len(asked) < 20
    reported = settings("ardupilot", GUID_TIMEOUT=0.5)
    assert len([t for t in range(0, 60_000, 10) if reported.due(t / 1000)]) == 6


@pytest.mark.parametrize(("autopilot", "name"), [("ardupilot", "GUID_TIMEOUT"), ("px4", "COM_OF_LOSS_T")])
def test_orbit_is_refused_when_the_autopilot_flies_on_without_setpoints(autopilot, name):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seconds=10, timeout_s=autopilot_of(autopilot).shipped_timeout_s))
    loop.start()
    loop.run(7.0)
    answer = loop.answers[0][1]
    assert not answer.accepted
    assert answer.condition.values["name"] == name
    assert all(row.action == Action.NOTHING for row in loop.rows)
    allowed = OrbitLoop(with_config(loop.settings, max_control_timeout_s=3.0))
    allowed.start()
    allowed.run(7.0)
    assert allowed.controller.safety.state == State.ORBITING


def test_settings_are_read_again_where_the_clock_goes_back():
    known = settings("ardupilot", GUID_TIMEOUT=0.5)
    assert known.due(1000.0) == ["GUID_TIMEOUT"]
    assert known.due(1000.1) == []
    assert known.due(5.0) == ["GUID_TIMEOUT"]
