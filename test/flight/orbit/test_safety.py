"""The room to stop in before the subject: own speed and chase count together."""

import dataclasses
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orbit_observations import BRAKE, GOOD, LIMITS, LOITER, changed, orbiting

from drocap_ros.errors import ParameterError
from drocap_ros.flight.autopilot.autopilot import LossSettings
from drocap_ros.flight.bridge_config import SafetyConfig
from drocap_ros.flight.conditions import ConditionCode, condition
from drocap_ros.flight.observed import Height
from drocap_ros.flight.orbit.motion_checks import battery_condition, stopping_room, subject_condition
from drocap_ros.flight.orbit.safety import by_hand, permit_mode, reduce, way_out
from drocap_ros.flight.orbit.states import (
    Action,
    Command,
    Fault,
    Holding,
    Idle,
    ModeRequest,
    Orbiting,
    Ready,
    Requesting,
    State,
    TakenOver,
)

#: What ends an orbit or forbids one: its code, and what is observed.
BAD = {
    "disturbance": (ConditionCode.CLOCK_JUMPED, {"disturbance": condition(ConditionCode.CLOCK_JUMPED, jump_s=3.0)}),
    "link": (ConditionCode.LINK_SILENT, {"link_age_s": 0.6}),
    "autopilot": (ConditionCode.AUTOPILOT_UNSUPPORTED, {"autopilot": "other"}),
    "heartbeat": (ConditionCode.MODE_OUTDATED, {"heartbeat_age_s": 3.0}),
    "attitude old": (ConditionCode.ATTITUDE_OUTDATED, {"state_age_s": 0.5}),
    "position frozen": (ConditionCode.POSITION_FROZEN, {"position_age_s": 0.5}),
    "round trip": (ConditionCode.ROUND_TRIP_TOO_LONG, {"round_trip_s": 1.9}),
    "position nan": (ConditionCode.VEHICLE_STATE_UNKNOWN, {"position": np.array([np.nan, 0, 0])}),
    "heading nan": (ConditionCode.VEHICLE_STATE_UNKNOWN, {"yaw": math.nan}),
    "landing": (ConditionCode.NOT_FLYING, {"landed_state": 4}),
    "px4 not known to fly": (ConditionCode.NOT_FLYING, {"autopilot": "px4", "landed_state": 0}),
    "gps": (ConditionCode.NO_SATELLITE_FIX, {"gps_fix_type": 1}),
    "estimator": (ConditionCode.ESTIMATOR_UNHEALTHY, {"position_ok": False}),
    "status": (ConditionCode.STATUS_OUTDATED, {"status_age_s": 2.0}),
    "battery unknown": (ConditionCode.BATTERY_UNKNOWN, {"battery_fraction": math.nan}),
    "battery low": (ConditionCode.BATTERY_LOW, {"battery_fraction": 0.1}),
    "too fast": (ConditionCode.TOO_FAST, {"velocity": np.array([0.0, 7.0, 0.0])}),
    "too high": (ConditionCode.TOO_HIGH, {"height_m": 21.0}),
    "climbing to the limit": (ConditionCode.TOO_HIGH, {"height_m": 18.5, "velocity": np.array([0, 0, 2.5])}),
    "too low": (ConditionCode.TOO_LOW, {"height_m": 1.0}),
    "low by a range finder": (ConditionCode.TOO_LOW, {"clearance_m": 1.1}),
    "low by the image": (ConditionCode.TOO_LOW, {"ground": Height(1.4, 0.2)}),
    "height contradicted": (
        ConditionCode.HEIGHT_CONTRADICTED,
        {"ground": Height(-3.0, 0.2), "height_m": 6.0, "position": np.array([6.0, 0, 1.0])},
    ),
    "subject none": (ConditionCode.NO_SUBJECT, {"subject": None}),
    "subject old": (ConditionCode.SUBJECT_OUTDATED, {"subject_age_s": 1.1}),
    "subject from the future": (ConditionCode.SUBJECT_OUTDATED, {"subject_age_s": -1.0}),
    "subject uncertain": (ConditionCode.SUBJECT_UNCERTAIN, {"subject_sd_m": 2.0}),
    "subject uncertain beyond words": (ConditionCode.SUBJECT_UNCERTAIN, {"subject_sd_m": math.nan}),
    "subject near": (ConditionCode.SUBJECT_NEAR, {"subject_distance_m": 2.9}),
    "subject nearing": (ConditionCode.SUBJECT_NEAR, {"subject_distance_m": 4.0, "closing_m_s": 2.0}),
    "subject far": (ConditionCode.SUBJECT_FAR, {"subject_distance_m": 25.0}),
    "subject nowhere": (ConditionCode.SUBJECT_NEAR, {"subject_distance_m": math.nan}),
}


def refusal(decision):
    assert not decision.answer.accepted
    return decision.answer.condition.code


def bad(name, base=GOOD):
    return changed(base, **BAD[name][1])


@pytest.mark.parametrize("name", BAD)
def test_start_is_refused_with_the_code_of_the_failed_condition(name):
    state, decision = reduce(Idle(), bad(name), 0.0, Command.START, LIMITS)
    assert state.state == State.IDLE
    assert decision.action == Action.NOTHING
    assert decision.answer.accepted is False
    assert decision.answer.condition.code == state.condition.code == BAD[name][0]
    assert str(decision.answer) == f"refused: {state.reason}"


@pytest.mark.parametrize("name", BAD)
def test_motion_ends_at_once_and_never_resumes_by_itself(name):
    state, decision = reduce(orbiting(), bad(name), 1.0, None, LIMITS)
    assert state.state == State.HOLDING
    assert decision.action in (Action.HOLD, Action.HALT)
    for i in range(100):
        state, decision = reduce(state, GOOD, 1.1 + 0.05 * i, None, LIMITS)
        assert decision.action == Action.HOLD
    state, decision = reduce(state, GOOD, 7.0, Command.START, LIMITS)
    assert state.state in (State.ORBITING, State.FAULT)  # the hold mode never came: then stop must acknowledge first


def test_hold_latches_the_position_requests_the_hold_mode_and_then_sends_nothing():
    moving = changed(GOOD, velocity=np.array([0.0, 2.0, 0.0]))
    state, decision = reduce(orbiting(), changed(moving, subject=None), 1.0, None, LIMITS)
    assert np.array_equal(state.position, GOOD.vehicle.position)
    assert decision == (Action.HOLD, ModeRequest.NONE, None)
    drifted = changed(moving, position=GOOD.vehicle.position + 1.0)
    state, decision = reduce(state, drifted, 2.0, None, LIMITS)
    assert np.array_equal(state.position, GOOD.vehicle.position)
    assert decision.mode_request == ModeRequest.NONE
    at_rest = changed(drifted, velocity=np.zeros(3))
    state, decision = reduce(state, at_rest, 2.1, None, LIMITS)
    assert decision.mode_request == ModeRequest.NONE  # it may only turn, to spring back
    state, decision = reduce(state, at_rest, 2.45, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.HOLD, None)
    state = permit_mode(state, "BRAKE")
    state, decision = reduce(state, BRAKE, 2.5, None, LIMITS)
    assert (state.state, decision.action, decision.mode_request) == (State.HOLDING, Action.NOTHING, ModeRequest.NONE)
    state, decision = reduce(state, GOOD, 3.0, None, LIMITS)  # back to GUIDED: somebody else's choice
    assert (state.state, decision.action) == (State.READY, Action.NOTHING)  # the pilot gives control, and waits


def test_hold_mode_is_requested_even_when_the_vehicle_does_not_come_to_rest():
    moving = changed(GOOD, velocity=np.array([0.0, 2.0, 0.0]), subject=None)
    state, decision = reduce(orbiting(), moving, 1.0, None, LIMITS)
    state, decision = reduce(state, moving, 4.5, None, LIMITS)
    assert decision.mode_request == ModeRequest.HOLD
    state, decision = reduce(state, moving, 10.0, None, LIMITS)
    assert state.state == State.FAULT
    assert state.condition.code == ConditionCode.HOLD_MODE_MISSING
    assert state.condition.values["cause"].code == ConditionCode.NO_SUBJECT
    assert decision == (Action.HOLD, ModeRequest.HOLD, None)
    state, decision = reduce(state, GOOD, 11.0, Command.START, LIMITS)
    assert refusal(decision) == ConditionCode.FAULT_NOT_ACKNOWLEDGED
    state, decision = reduce(state, GOOD, 12.0, Command.STOP, LIMITS)
    assert state.state == State.READY


def test_hold_without_a_trustworthy_state_keeps_the_last_position_and_requests_no_mode():
    lost = changed(GOOD, state_age_s=0.05, position_age_s=0.45)  # frozen
    lost = changed(lost, velocity=np.array([0.0, 2.0, 0.0]))
    state, decision = reduce(orbiting(), lost, 1.0, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.NONE, None)
    assert np.allclose(state.position, [6.0, 0.8, 2.5])  # carried on by the last velocity
    lost = changed(lost, link_age_s=3.0)
    _, decision = reduce(state, lost, 4.0, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.NONE, None)
    _, decision = reduce(state, lost, 12.0, None, LIMITS)
    assert decision == (Action.NOTHING, ModeRequest.NONE, None)
    older = changed(lost, position_age_s=0.8)
    state, decision = reduce(orbiting(), older, 1.0, None, LIMITS)
    assert decision == (Action.HALT, ModeRequest.NONE, None)
    back, decision = reduce(state, GOOD, 2.5, None, LIMITS)
    assert decision.action == Action.HOLD
    assert np.array_equal(back.position, GOOD.vehicle.position)


def test_hold_without_satellite_fix_sends_velocity_zero_then_requests_the_hold_mode():
    state, decision = reduce(orbiting(), bad("gps"), 1.0, None, LIMITS)
    assert decision == (Action.HALT, ModeRequest.NONE, None)
    _, decision = reduce(state, bad("gps"), 3.5, None, LIMITS)
    assert decision == (Action.HALT, ModeRequest.HOLD, None)


def test_fence_includes_the_braking_distance():
    state = orbiting()
    out = changed(GOOD, position=np.array([38.5, 0, 2.5]), velocity=np.array([2.0, 0, 0]))
    held, _ = reduce(state, out, 1.0, None, LIMITS)
    assert held.state == State.HOLDING
    assert held.condition.code == ConditionCode.AT_FENCE
    inward = changed(out, velocity=np.array([-2.0, 0, 0]))
    assert reduce(state, inward, 1.0, None, LIMITS)[0].state == State.ORBITING


@pytest.mark.parametrize("mode", ["LOITER", "STABILIZE", "RTL", "BRAKE", "LAND"])
def test_uncommanded_mode_is_a_take_over_and_nothing_is_sent(mode):
    other = changed(GOOD, mode=mode, in_control=False, in_hold=mode == "BRAKE")
    held = reduce(orbiting(), bad("subject none"), 1.0, None, LIMITS)[0]
    for state in (orbiting(), held):
        state, decision = reduce(state, other, 2.0, None, LIMITS)
        assert state.state == State.TAKEN_OVER
        for i, seen in enumerate((other, GOOD, BRAKE, GOOD, bad("link"))):
            for command in (None, Command.START, Command.ENGAGE, Command.ADJUST):
                state, decision = reduce(state, seen, 3.0 + i, command, LIMITS)
                assert (state.state, decision.action) == (State.TAKEN_OVER, Action.NOTHING)
                assert decision.mode_request == ModeRequest.NONE
                assert command is None or not decision.answer.accepted
        state, decision = reduce(state, GOOD, 10.0, Command.STOP, LIMITS)
        assert state.state == State.READY


def test_start_never_changes_the_mode_and_engage_only_when_allowed():
    state, decision = reduce(Idle(), LOITER, 0.0, Command.START, LIMITS)
    assert refusal(decision) == ConditionCode.NOT_IN_CONTROL_MODE
    assert decision.mode_request == ModeRequest.NONE
    forbidden = dataclasses.replace(LIMITS, mode_change_allowed=False)
    state, decision = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, forbidden)
    assert refusal(decision) == ConditionCode.MODE_CHANGE_FORBIDDEN
    assert decision.mode_request == ModeRequest.NONE
    lossy = changed(LOITER, packet_loss=0.4)
    state, decision = reduce(Idle(), lossy, 0.0, Command.ENGAGE, LIMITS)
    assert refusal(decision) == ConditionCode.PACKETS_LOST
    assert "40 % of the autopilot's packets" in str(decision.answer.condition)
    assert decision.mode_request == ModeRequest.NONE
    named = changed(LOITER, packet_loss=decision.answer.condition.values["most_percent"] / 100)
    assert reduce(Idle(), named, 0.0, Command.ENGAGE, LIMITS)[1].answer.accepted
    state, decision = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    assert decision.mode_request == ModeRequest.CONTROL
    state, decision = reduce(permit_mode(state, "GUIDED"), GOOD, 0.3, None, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)


def test_why_an_engage_ended_without_an_orbit_stays_until_the_next_command():
    requesting = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)[0]
    state = reduce(requesting, bad("gps", LOITER), 1.0, None, LIMITS)[0]
    assert (state.state, state.failed.code) == (State.IDLE, ConditionCode.REQUEST_ENDED)
    assert "satellite" in str(state.failed)
    state = reduce(state, bad("battery low", LOITER), 2.0, None, LIMITS)[0]
    assert state.condition.code == ConditionCode.BATTERY_LOW
    for now_s in (3.0, 60.0):
        state = reduce(state, LOITER, now_s, None, LIMITS)[0]
        assert (state.state, state.condition) == (State.READY, state.failed)
    assert reduce(state, LOITER, 61.0, Command.STOP, LIMITS)[0].failed is None
    again = reduce(state, LOITER, 61.0, Command.ENGAGE, LIMITS)[0]
    assert isinstance(again, Requesting)


@pytest.mark.parametrize(
    ("state", "seen", "words"),
    [
        (Ready(), GOOD, "`drocap orbit start` begins"),
        (Ready(), LOITER, "`drocap orbit engage` requests control and begins an orbit, or switch to"),
        (Holding(), GOOD, "`drocap orbit start` begins"),
        (Holding(), changed(GOOD, stream_gap_s=3.0), "nothing is sent any more; `drocap orbit start`"),
        (TakenOver(), LOITER, "`drocap orbit stop` acknowledges"),
        (Fault(), GOOD, "`drocap orbit stop` acknowledges"),
        (Orbiting(), GOOD, ""),
        (Idle(), GOOD, ""),
    ],
)
def test_a_state_says_what_leads_out(state, seen, words):
    found = way_out(state, seen, LIMITS)
    assert found.startswith(words)
    assert bool(found) == bool(words)


def test_without_the_permission_to_change_the_mode_the_pilot_or_the_configuration_leads_out():
    forbidden = dataclasses.replace(LIMITS, mode_change_allowed=False)
    for seen in (LOITER, changed(LOITER, autopilot="px4")):
        found = way_out(Ready(), seen, forbidden)
        assert "set it to true" in found
        assert found.endswith(by_hand(seen))


@pytest.mark.parametrize(
    "state", [Ready(), Holding(), TakenOver(), Fault(), Idle()], ids=lambda state: state.state.name
)
@pytest.mark.parametrize("name", [None, *BAD])
@pytest.mark.parametrize("mode", [GOOD, LOITER, BRAKE, changed(LOITER, packet_loss=0.4)])
def test_a_command_that_the_way_out_names_is_accepted(state, name, mode):
    if isinstance(state, Holding):
        state = dataclasses.replace(state, modes=frozenset({mode.mode.name}), fence_centre=np.array([50.0, 0.0]))
    seen = bad(name, mode) if name else mode
    state = reduce(state, seen, 0.0, None, LIMITS)[0]
    named = re.search("`drocap orbit ([a-z]+)`", way_out(state, seen, LIMITS))
    if named is not None:
        answer = reduce(state, seen, 0.1, Command[named[1].upper()], LIMITS)[1].answer
        assert answer.accepted, (way_out(state, seen, LIMITS), str(answer))


def test_after_a_hold_at_the_fence_the_next_orbit_has_a_fence_of_its_own():
    far = np.array([50.0, 0.0])  # from the vehicle
    held = Holding(0.0, condition(ConditionCode.AT_FENCE), modes=frozenset({"GUIDED", "BRAKE"}), fence_centre=far)
    assert refusal(reduce(held, GOOD, 0.0, Command.START, LIMITS)[1]) == ConditionCode.AT_FENCE
    assert way_out(held, GOOD, LIMITS) == ""  # the condition says it
    state, decision = reduce(held, BRAKE, 0.0, Command.ENGAGE, LIMITS)
    assert decision.answer.accepted
    assert np.abs(reduce(state, GOOD, 0.1, None, LIMITS)[0].fence_centre - far).max() > 10.0


def test_engage_warms_up_times_out_and_yields_to_pilot_and_failed_conditions():
    loiter = dataclasses.replace(LOITER, autopilot=dataclasses.replace(LOITER.autopilot, warm_up_s=1.2))
    state, decision = reduce(Idle(), loiter, 0.0, Command.ENGAGE, LIMITS)
    assert decision[:2] == (Action.HOLD, ModeRequest.NONE)
    assert decision.answer.condition.code == ConditionCode.REQUESTING_CONTROL
    assert reduce(state, loiter, 1.1, None, LIMITS)[1].mode_request == ModeRequest.NONE
    assert reduce(state, loiter, 1.3, None, LIMITS)[1].mode_request == ModeRequest.CONTROL
    assert reduce(state, loiter, 7.0, None, LIMITS)[0].condition.code == ConditionCode.CONTROL_NOT_GRANTED
    assert reduce(state, changed(loiter, mode="LAND"), 1.0, None, LIMITS)[0].state == State.TAKEN_OVER
    assert reduce(state, bad("gps", loiter), 1.0, None, LIMITS)[1].action == Action.NOTHING
    assert reduce(state, loiter, 1.0, Command.STOP, LIMITS)[1].action == Action.NOTHING


@pytest.mark.parametrize("speed_m_s", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("granted_s", [0.2, 1.0, 4.0])
def test_a_pending_engage_holds_the_vehicle_where_it_is_while_the_pilot_flies_on(speed_m_s, granted_s):
    """The grant is seen late: until then what is sent must lead nowhere, least of all back or nearer."""
    state, _ = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    for step in range(1, round(granted_s * 20)):
        now_s = 0.05 * step
        angle = speed_m_s * now_s / 6.0
        about = np.array([6.0 * np.cos(angle), 6.0 * np.sin(angle), 2.5])
        seen = changed(LOITER, position=about, yaw=0.1 * now_s)
        state, decision = reduce(state, seen, now_s, None, LIMITS)
        assert decision.action == Action.HOLD
        np.testing.assert_array_equal(state.position, about)
        assert state.yaw == 0.1 * now_s
    nearer = changed(seen, subject_distance_m=2.0)
    assert reduce(state, nearer, now_s + 0.05, None, LIMITS)[1].action == Action.NOTHING


@pytest.mark.parametrize("end", ["stop", "time-out", "gps"])
@pytest.mark.parametrize("later_s", [0.05, 1.0, 3.0, 4.9])
def test_control_that_is_granted_when_nobody_asks_for_it_any_more_is_held_where_the_vehicle_is(end, later_s):
    state, _ = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    state, _ = reduce(state, LOITER, 0.5, None, LIMITS)
    ended_s = 20.0 if end == "time-out" else 1.0
    seen, command = (bad("gps", LOITER), None) if end == "gps" else (LOITER, Command.STOP if end == "stop" else None)
    state, decision = reduce(state, seen, ended_s, command, LIMITS)
    assert decision.action == Action.NOTHING
    place = GOOD.vehicle.position + np.array([0.7, -0.4, 0.2])
    state, decision = reduce(state, changed(GOOD, position=place), ended_s + later_s, None, LIMITS)
    assert (state.state, decision.action) == (State.HOLDING, Action.HOLD)
    assert np.linalg.norm(state.position - place) < 0.5  # where it can stop
    # A pilot who enters the control mode long after is not held.
    state, _ = reduce(Idle(), LOITER, 0.0, Command.ENGAGE, LIMITS)
    state, _ = reduce(state, LOITER, 0.5, Command.STOP, LIMITS)
    assert reduce(state, GOOD, 7.0, None, LIMITS)[1].action == Action.NOTHING


def test_disarming_ends_the_orbit_and_disabled_commands_are_refused():
    state, decision = reduce(orbiting(), changed(GOOD, armed=False), 1.0, None, LIMITS)
    assert (state.state, decision.action) == (State.IDLE, Action.NOTHING)
    off = dataclasses.replace(LIMITS, commands_enabled=False)
    state, decision = reduce(Idle(), GOOD, 0.0, Command.START, off)
    assert refusal(decision) == ConditionCode.COMMANDS_DISABLED


_SEEN = [GOOD, LOITER, BRAKE, changed(GOOD, armed=False), *(bad(name) for name in BAD)]


def near(distance_m, **values):
    place = np.array([distance_m, 0, 2.5])
    return changed(GOOD, position=place, subject_distance_m=distance_m, approach_m_s=1.3, **values)


def test_hold_position_retreats_from_an_approaching_subject():
    state = orbiting()
    for step, distance in enumerate((4.0, 3.9, 3.8, 3.7)):
        state, decision = reduce(state, near(distance, velocity=np.array([1.0, 0, 0])), 10.0 + step, None, LIMITS)
        assert decision == (Action.HOLD, ModeRequest.NONE, None)
    assert state.position[0] > 3.7 + 1.0  # ahead of a vehicle that moves out, up to the fence
    assert state.position[2] == 2.5
    # The subject stands: the hold position stays, and the autopilot's own hold follows.
    still = changed(near(6.5), approach_m_s=0.0)
    after, _ = reduce(state, still, 14.0, None, LIMITS)
    assert (after.position == state.position).all()
    assert reduce(after, still, 15.0, None, LIMITS)[1].mode_request == ModeRequest.HOLD


def test_vehicle_that_moves_away_fast_is_held_where_it_can_stop():
    """Led back to where the hold began it came back at 1.2 m/s."""
    begun = [
        reduce(orbiting(), changed(
            GOOD, position=np.array([8.0, 0.0, 2.5]), velocity=np.array([away, 0.0, 0.0]), subject_distance_m=8.0,
            closing_m_s=-away, approach_m_s=0.0, subject_sd_m=2.0,
        ), 10.0, None, LIMITS)[0] for away in (0.5, 1.8)
    ]  # fmt: skip
    assert [state.state for state in begun] == [State.HOLDING] * 2
    assert begun[0].position[0] == pytest.approx(8.0)
    assert begun[1].position[0] == pytest.approx(9.5)


@pytest.mark.parametrize("north_m", np.arange(0.0, 40.0, 5.0))
@pytest.mark.parametrize("east_m", [10.0, 30.0, 33.0, 35.0, 37.0, 39.5, 40.5])
def test_a_retreat_ends_at_the_fence_and_never_leads_to_the_subject(east_m, north_m):
    """It once led back to 8 m inside the fence, through the person."""
    here, state = np.array([east_m, north_m, 2.5]), orbiting()
    for step, distance in enumerate((2.9, 2.8, 2.7, 2.6)):
        away = np.array([distance, 0.0, 1.6])
        seen = changed(
            GOOD, position=here, subject=here - away, subject_distance_m=distance, approach_m_s=0.5, link_age_s=0.02
        )
        state, decision = reduce(state, seen, 10.0 + 0.05 * step, None, LIMITS)
        assert decision.action == Action.HOLD
        hold = state.position
        assert hold[0] >= east_m
        assert hold[1] == pytest.approx(north_m)
        centre_m, own_m = np.linalg.norm(hold[:2]), np.linalg.norm(here[:2])
        assert centre_m <= max(LIMITS.fence_radius_m, own_m) + 1e-6
    assert state.position[0] > east_m or own_m > 39.0  # it does retreat


@pytest.mark.parametrize(("east_m", "held_m"), [(30.0, 31.5), (38.8, 40.0), (40.2, 40.2)])
def test_a_hold_on_the_way_out_ends_at_the_fence(east_m, held_m):
    seen = changed(
        GOOD, position=np.array([east_m, 0, 2.5]), velocity=np.array([1.4, 0, 0]), closing_m_s=-1.4,
        subject=np.array([east_m - 4.5, 0, 0.9]), subject_distance_m=4.5,
    )  # fmt: skip
    state, _ = reduce(orbiting(), seen, 10.0, Command.STOP, LIMITS)
    assert state.state == State.HOLDING
    assert state.position[0] == pytest.approx(held_m)


def test_a_stop_ends_the_retreat():
    state, _ = reduce(orbiting(), near(4.0), 10.0, None, LIMITS)
    state, _ = reduce(state, near(3.9), 10.1, None, LIMITS)
    assert state.position[0] > 5.0
    state, decision = reduce(state, near(3.8), 10.2, Command.STOP, LIMITS)
    assert (decision.answer.accepted, state.condition.code) == (True, ConditionCode.STOPPED)
    for step in range(20):
        state, decision = reduce(state, near(3.7), 10.3 + 0.05 * step, None, LIMITS)
        assert (state.position[0], decision.action) == (3.8, Action.HOLD)


def test_a_hold_follows_a_jump_of_the_reported_position():
    """Else the vehicle flies to the old numbers, which name another place now."""
    state, _ = reduce(orbiting(), GOOD, 10.0, Command.STOP, LIMITS)
    jumped = condition(ConditionCode.POSITION_JUMPED, jump_m=5.0)
    seen = changed(GOOD, position=np.array([11.0, 0.0, 2.5]), disturbance=jumped)
    state, decision = reduce(state, seen, 10.1, None, LIMITS)
    assert (state.position, decision.action) == (None, Action.HALT)
    seen = changed(seen, disturbance=None)
    for step in range(12):
        state, decision = reduce(state, seen, 10.15 + 0.05 * step, None, LIMITS)
    assert (state.position.tolist(), decision.action) == ([11.0, 0.0, 2.5], Action.HOLD)


@pytest.mark.parametrize(
    ("seen", "command"),
    [
        (GOOD, Command.STOP),
        (changed(GOOD, subject_sd_m=2.0), None),
        (changed(GOOD, subject_age_s=1.1), None),
        (changed(GOOD, battery_fraction=0.1), None),
    ],
)
def test_hold_for_another_reason_than_nearness_does_not_move(seen, command):
    state, _ = reduce(orbiting(), seen, 10.0, command, LIMITS)
    place = state.position.copy()
    state, decision = reduce(state, near(3.2), 10.2, None, LIMITS)
    assert decision.action == Action.HOLD
    assert (state.position == place).all()


@pytest.mark.parametrize(
    "values", [{"subject_age_s": 0.5}, {"subject_sd_m": 2.0}, {"subject": None}, {"gps_fix_type": 1}]
)
def test_hold_retreats_only_from_a_located_subject(values):
    state, _ = reduce(orbiting(), near(4.0), 10.0, None, LIMITS)
    place = state.position.copy()
    state, _ = reduce(state, near(3.2, **values), 10.2, None, LIMITS)
    assert (state.position == place).all()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(_SEEN), st.sampled_from([None, None, *Command])), max_size=60))
def test_invariants_hold_in_any_history(history):
    state, started = Idle(), False
    for i, (seen, command) in enumerate(history):
        before = state
        state, decision = reduce(state, seen, 0.25 * i, command, LIMITS)
        started = command in (Command.START, Command.ENGAGE)
        if decision.action == Action.ORBIT:
            assert not any(seen is s for s in _SEEN[1:])  # only with everything good
            assert before.state == State.ORBITING or started or isinstance(before, Requesting)
        if before.state == State.TAKEN_OVER and command != Command.STOP:
            assert state.state == State.TAKEN_OVER
            assert decision[:2] == (Action.NOTHING, ModeRequest.NONE)
        if state.state in (State.IDLE, State.TAKEN_OVER):
            assert decision[:2] == (Action.NOTHING, ModeRequest.NONE)
        if decision.mode_request == ModeRequest.CONTROL:
            assert isinstance(state, Requesting)
        if decision.mode_request != ModeRequest.NONE:
            wanted = "GUIDED" if decision.mode_request == ModeRequest.CONTROL else "BRAKE"
            state = permit_mode(state, wanted)
        assert state.reason


def test_contradicting_limits_are_refused():
    with pytest.raises(ParameterError, match="max_height_m"):
        SafetyConfig(min_height_m=5.0, max_height_m=5.5)


def test_speed_shortens_the_allowed_age_of_the_subject():
    def stopped(speed, age_s):
        seen = changed(GOOD, velocity=np.array([0.0, speed, 0.0]), subject_age_s=age_s)
        state, decision = reduce(orbiting(), seen, 1.0, None, LIMITS)
        assert decision.action == Action.ORBIT  # the orbit stands, and goes on when the subject is located again
        return state.pace.value == 0.0

    assert not stopped(2.0, 0.33)
    assert stopped(2.0, 0.34)
    assert stopped(2.5, 0.36)
    assert not stopped(2.5, 0.33)
    assert not stopped(4.4, 0.24)  # not below what a camera and a network take
    assert stopped(4.4, 0.26)


def test_hold_mode_is_requested_at_once_when_setpoints_are_not_followed():
    ignored = condition(ConditionCode.SETPOINTS_NOT_FOLLOWED, evidence="no echo")
    deaf = changed(GOOD, followed=False, disturbance=ignored)
    _, decision = reduce(orbiting(), deaf, 1.0, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.HOLD, None)
    _, decision = reduce(orbiting(), changed(deaf, followed=True), 1.0, None, LIMITS)
    assert decision == (Action.HOLD, ModeRequest.NONE, None)


def test_too_long_a_timeout_of_the_autopilot_forbids_motion():
    seen = changed(GOOD, loss_settings=LossSettings("GUID_TIMEOUT", 3.0, "", math.nan))
    limits = dataclasses.replace(LIMITS, max_control_timeout_s=0.5)
    _, decision = reduce(Idle(), seen, 0.0, Command.START, limits)
    assert refusal(decision) == ConditionCode.TIMEOUT_TOO_LONG
    assert reduce(orbiting(), seen, 1.0, None, limits)[0].state == State.HOLDING
    assert reduce(orbiting(), seen, 1.0, None, LIMITS)[0].state == State.ORBITING


def test_a_least_voltage_needs_a_known_one():
    safety = SafetyConfig(min_battery_voltage_v=14.0)
    assert battery_condition(0.9, math.nan, safety).code == ConditionCode.BATTERY_UNKNOWN
    assert battery_condition(math.nan, 15.0, safety) is None
    assert battery_condition(0.9, 13.9, safety).code == ConditionCode.BATTERY_LOW


SAFETY = LIMITS
BRAKING = SAFETY.braking_m_s2


def seen(distance_m=6.0, **values):
    place = np.array([distance_m, 0.0, 2.5])
    return changed(GOOD, position=place, subject_distance_m=distance_m, subject_sd_m=0.0, **values)


def braking(speed):
    return speed**2 / (2 * BRAKING)


def test_own_speed_and_chase_count_together():
    # The estimate recedes at 1 m/s and the vehicle closes at 2.5: the person may stand.
    room = stopping_room(seen(closing_m_s=2.5, approach_m_s=-1.0), SAFETY)
    assert room > braking(2.5) > braking(1.5) + braking(1.0)
    assert room == pytest.approx(braking(2.5), abs=0.3)
    # A vehicle that has fallen behind will follow at the speed of the chase.
    assert stopping_room(seen(closing_m_s=0.0, approach_m_s=-1.4), SAFETY) > braking(1.4)
    # A person who comes nearer walks on until the vehicle stands.
    both = stopping_room(seen(closing_m_s=1.0, approach_m_s=1.0), SAFETY)
    assert both > braking(1.0) + 1.0 * (0.5 + 1.0 / BRAKING)
    assert stopping_room(seen(closing_m_s=-2.0), SAFETY) < 0.1


def test_vehicle_that_flies_away_as_fast_as_the_person_comes_needs_no_room_for_his_steps():
    # The vehicle followed him, and he turned: a hold would end the flight away from him.
    away = stopping_room(seen(closing_m_s=-1.3, approach_m_s=1.3), SAFETY)
    assert away < 0.2
    gains = stopping_room(seen(closing_m_s=-0.5, approach_m_s=1.3), SAFETY)
    assert gains >= away + 0.8 * 0.5
    assert stopping_room(seen(closing_m_s=0.0, approach_m_s=1.3), SAFETY) >= 1.3 * 0.5


def test_uncertainty_of_position_and_speeds_is_added():
    calm = changed(seen(closing_m_s=1.0), subject_sd_m=0.4)
    assert stopping_room(calm, SAFETY) >= braking(1.0) + 0.4
    # Faster by a standard deviation than estimated, until the vehicle reacts.
    unsure = changed(calm, approach_sd_m_s=0.6)
    assert stopping_room(unsure, SAFETY) - stopping_room(calm, SAFETY) == pytest.approx(0.5 - 0.4)


def test_orbit_ends_before_the_vehicle_cannot_stop_any_more():
    # 2.4 m of room are needed at 2.5 m/s; two separate distances would have been 1.3 m.
    near = seen(5.0, closing_m_s=2.5, approach_m_s=-1.0)
    assert subject_condition(near, LIMITS).code == ConditionCode.SUBJECT_NEAR
    assert reduce(orbiting(), near, 1.0, None, LIMITS)[0].state == State.HOLDING
    assert subject_condition(seen(5.8, closing_m_s=2.5, approach_m_s=-1.0), LIMITS) is None


def test_where_the_speed_decides_the_words_of_a_near_subject_name_its_share():
    near = changed(GOOD, subject_distance_m=7.1, closing_m_s=4.0)
    words = str(reduce(orbiting(), near, 1.0, None, LIMITS)[0].condition)
    room_m = float(words.split("the last ")[1].split(" m")[0])
    assert "7.1 m away" in words
    assert 7.1 - room_m < 3.0


def test_a_body_that_seems_small_forbids_a_start_and_ends_no_orbit():
    crouching = changed(GOOD, ground=Height(-2.0, 0.3))  # 4.5 m by the image, 2.5 m as reported
    _, decision = reduce(Idle(), crouching, 0.0, Command.START, LIMITS)
    assert decision.answer.condition.code == ConditionCode.HEIGHT_CONTRADICTED
    state, _ = reduce(orbiting(), crouching, 1.0, None, LIMITS)
    assert state.state == State.ORBITING
