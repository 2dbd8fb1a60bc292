import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.autopilot_settings import AutopilotSettings
from drocap_ros.flight.orbit.safety import Action, State
from drocap_ros.simulation.closed_loop.orbit_loop import LoopSettings, OrbitLoop, with_config

MAV = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
REAL, INTEGER = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32


def settings(autopilot, **values):
    known = AutopilotSettings()
    known.set_autopilot(autopilot)
    for name, value in values.items():
        kind = INTEGER if isinstance(value, int) else REAL
        raw = value * 2.0**-149 if isinstance(value, int) else value  # the integer's bytes, read as a float
        (message,) = mavlink.MAVLink(None).parse_buffer(
            MAV.param_value_encode(name.encode(), raw, kind, 9, 0).pack(MAV)
        )
        known.take(message)
    return known


@pytest.mark.parametrize(
    ("autopilot", "values", "words"),
    [
        ("ardupilot", {}, "has not told its GUID_TIMEOUT"),
        ("ardupilot", {"GUID_TIMEOUT": math.nan}, "has not told"),
        ("ardupilot", {"GUID_TIMEOUT": 3.0}, "fly on for 3 s without us; set GUID_TIMEOUT to 0.5"),
        ("ardupilot", {"GUID_TIMEOUT": 0.5}, ""),
        ("px4", {"COM_OBL_RC_ACT": 5}, "has not told its COM_OF_LOSS_T"),
        ("px4", {"COM_OF_LOSS_T": 1.0}, "fly on for 1 s without us; set COM_OF_LOSS_T"),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 7}, "the motors are stopped"),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 6}, "terminated"),
        ("px4", {"COM_OF_LOSS_T": 0.5, "COM_OBL_RC_ACT": 5}, ""),
        ("other", {}, ""),
    ],
)
def test_what_forbids_to_fly(autopilot, values, words):
    known = settings(autopilot, **values)
    found = known.problem(0.5)
    assert words in found
    assert bool(found) == bool(words)
    assert known.problem(0.0) == ""


def test_drift_is_a_warning():
    assert "altitude" in settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=1).warning()
    assert settings("px4", COM_OF_LOSS_T=0.5, COM_OBL_RC_ACT=5).warning() == ""
    assert settings("ardupilot", GUID_TIMEOUT=0.5).warning() == ""


def test_asked_until_told_and_then_rarely():
    known = settings("ardupilot")
    asked = [t for t in range(0, 60_000, 10) if known.due(t / 1000)]
    assert len([t for t in asked if t < 7000]) == 10
    assert len(asked) < 20
    told = settings("ardupilot", GUID_TIMEOUT=0.5)
    assert len([t for t in range(0, 60_000, 10) if told.due(t / 1000)]) == 6


@pytest.mark.parametrize(("autopilot", "name"), [("ardupilot", "GUID_TIMEOUT"), ("px4", "COM_OF_LOSS_T")])
def test_a_vehicle_that_would_fly_on_is_not_flown(autopilot, name):
    loop = OrbitLoop(LoopSettings(autopilot=autopilot, seconds=10, guid_timeout_s=3.0, offboard_loss_s=1.0))
    loop.start()
    loop.run(7.0)
    assert name in loop.answers[0][1]
    assert loop.answers[0][1].startswith("refused")
    assert all(row.action == Action.NOTHING for row in loop.rows)
    allowed = OrbitLoop(with_config(loop.settings, max_control_timeout_s=3.0))
    allowed.start()
    allowed.run(7.0)
    assert allowed.controller.safety.state == State.ORBITING
