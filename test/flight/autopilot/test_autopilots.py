"""What every autopilot's object must hold, and that an unknown one is nobody's."""

import math

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import AUTOPILOTS, UNKNOWN, autopilot_by_heartbeat, autopilot_of, supported_titles
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.mavlink.reports import ModeReports
from drocap_ros.flight.orbit.motion_checks import loss_condition

#: Numbers of the modes by their names.
PYMAVLINK = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: {name: number for number, name in mavutil.mode_mapping_acm.items()},
    mavlink.MAV_AUTOPILOT_PX4: {name: main << 16 | sub << 24 for name, (_, main, sub) in mavutil.px4_map.items()},
}
EVERY = pytest.mark.parametrize("autopilot", AUTOPILOTS.values(), ids=AUTOPILOTS)


@EVERY
def test_modes_for_flight_are_in_its_table_by_the_names_of_pymavlink(autopilot):
    assert {autopilot.control_mode, autopilot.hold_mode, autopilot.handed_over_mode} <= set(autopilot.modes)
    for mode, number in autopilot.modes.items():
        assert autopilot.mode_name(number) == mode
        assert number == PYMAVLINK[autopilot.mav_autopilot][mode]
        main, sub = autopilot.mode_numbers(mode)
        assert number == (main << 16 | sub << 24 if autopilot.submodes else main)
        reports = ModeReports()
        reports.take_heartbeat(mavlink.MAVLink_heartbeat_message(2, autopilot.mav_autopilot, 1, number, 4, 3), False, 0)
        assert (reports.autopilot, reports.mode) == (autopilot, mode)


@EVERY
def test_settings_that_decide_without_setpoints_are_read_before_a_flight(autopilot):
    assert autopilot.timeout_setting in autopilot.loss_names
    assert set(autopilot.loss_names) <= set(autopilot.preflight_names)
    settings = autopilot.loss_settings({autopilot.timeout_setting: 0.5})
    assert autopilot.timeout_s(settings) == 0.5
    assert autopilot.timeout_s(autopilot.loss_settings({})) == autopilot.shipped_timeout_s
    if (action := autopilot.loss_action) is not None:
        assert action.hold not in action.fatal | action.leaves
        assert set(action.words) >= set(action.fatal) | set(action.leaves) | set(action.modes)


@EVERY
def test_a_simulated_one_reports_settings_with_which_motion_is_allowed(autopilot):
    settings = autopilot.loss_settings(autopilot.simulated.settings)
    longest_s = MavlinkBridgeConfig().max_control_timeout_s
    assert loss_condition(settings, autopilot.loss_action, longest_s) is None


@EVERY
def test_a_fence_that_is_not_reported_is_a_problem(autopilot):
    if autopilot.fence is not None:
        assert "not reported" in autopilot.fence.read(lambda _: math.nan).problem


@pytest.mark.parametrize("number", [1, 4, 8, 255])
def test_another_autopilot_is_unknown_and_has_no_mode_to_fly_in(number):
    assert autopilot_by_heartbeat(number) is UNKNOWN
    assert autopilot_of("betaflight") is autopilot_of("") is UNKNOWN
    assert not UNKNOWN.supported
    assert UNKNOWN.loss_settings({}) is None
    assert UNKNOWN.title not in supported_titles()
