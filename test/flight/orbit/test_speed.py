"""Degrade, hold, hand over: what old data do to an orbit, and how it goes on."""

import dataclasses

import numpy as np
import pytest
from orbit_observations import BRAKE, GOOD, LIMITS, LOITER, changed, orbiting

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.safety import permit_mode, reduce
from drocap_ros.flight.orbit.speed import allowed_pace, next_pace, slowed, waiting
from drocap_ros.flight.orbit.states import Action, Command, ModeRequest, Pace, State

OLD = {
    "late picture": {"subject_age_s": 1.1},
    "attitude": {"state_age_s": 0.5},
    "position": {"position_age_s": 0.5},
}
NOT_HARMLESS = {
    "silent link": {"link_age_s": 0.5, "state_age_s": 0.5},
    "near": {"subject_distance_m": 2.9},
    "uncertain": {"subject_sd_m": 2.0},
    "battery": {"battery_fraction": 0.1},
    "satellites": {"gps_fix_type": 1},
}


def seen(**values):
    return changed(GOOD, **values)


def fly(state, observed, seconds, start_s, limits=LIMITS, command=None):
    """The state after these seconds of one observation; the command comes with the first step."""
    actions = []
    for i in range(round(seconds / 0.05)):
        state, decision = reduce(state, observed, start_s + 0.05 * i, command if i == 0 else None, limits)
        actions.append(decision.action)
    return state, actions


@pytest.mark.parametrize("name", ["subject_age_s", "link_age_s", "state_age_s", "position_age_s"])
def test_pace_falls_with_every_age_from_one_to_zero(name):
    paces = [allowed_pace(seen(**{name: age_s}), LIMITS)[0] for age_s in np.arange(0.0, 0.5, 0.01)]
    assert paces[:20] == [1.0] * 20
    assert paces == sorted(paces, reverse=True)
    assert paces[-9] == 0.0  # 0.41 s
    assert len(set(paces)) > 8
    assert allowed_pace(seen(**{name: 0.28}), LIMITS)[1] is not None


def test_pace_ends_sooner_at_speed():
    fast = seen(subject_age_s=0.3, velocity=np.array([0.0, 3.4, 0.0]))
    assert allowed_pace(fast, LIMITS)[0] == 0.0
    assert 0.2 < allowed_pace(changed(fast, velocity=np.zeros(3)), LIMITS)[0] < 0.5


def test_usual_age_is_flown_at_full_speed_and_setpoints_stand_before_a_third_of_a_second():
    assert allowed_pace(seen(subject_age_s=0.17 + 1 / 15), LIMITS)[0] == 1.0
    assert allowed_pace(seen(subject_age_s=0.32), LIMITS)[0] > 0.0
    assert allowed_pace(seen(subject_age_s=0.335), LIMITS)[0] == 0.0
    slow_network = dataclasses.replace(LIMITS, max_subject_age_s=1.2)
    assert allowed_pace(seen(subject_age_s=0.5, velocity=np.zeros(3)), slow_network)[0] > 0.5


def test_orbit_slows_down_for_a_late_picture_and_goes_on_from_the_speed_that_is_left():
    state, _ = fly(orbiting(), GOOD, 1.0, 1.0)
    assert state.pace.value == 1.0
    for i, age_s in enumerate((0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55)):
        state, decision = reduce(state, seen(subject_age_s=age_s), 2.0 + 0.05 * i, None, LIMITS)
        assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
        assert state.condition.code == ConditionCode.DEGRADED
        assert state.condition.values["cause"].code == ConditionCode.SUBJECT_OUTDATED
    assert state.pace.value == 0.0
    state, _ = reduce(state, GOOD, 2.35, None, LIMITS)
    assert 0.7 < state.pace.value < 0.9
    assert state.condition.code == ConditionCode.DEGRADED
    state, _ = fly(state, GOOD, 1.0, 2.4)
    assert state.pace.value == 1.0
    assert state.condition.code == ConditionCode.ORBITING


def test_orbit_that_stood_goes_on_along_a_ramp():
    pace = Pace(0.0, 0.0, 0.0, 5.0)
    values = [pace.value]
    for i in range(1, 60):
        pace = next_pace(pace, 1.0, 5.0 + 0.05 * i)
        values.append(pace.value)
    assert values[-1] == 1.0
    assert max(np.diff(values)) < 0.05
    assert 1.0 < np.argmax(np.array(values) == 1.0) * 0.05 < 2.0


def test_orbit_that_stood_for_pictures_of_something_else_goes_on_from_a_stand():
    late, other = (next_pace(Pace(), 0.0, 0.05, contradicted=something_else) for something_else in (False, True))
    assert next_pace(late, 1.0, 0.1).value > 0.9
    assert next_pace(other, 1.0, 0.1).value < 0.05


def test_standing_setpoint_stays_where_the_vehicle_was_and_leaves_along_the_way():
    far = Setpoint(np.array([1.5, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.zeros(3), 1.0, 0.3)
    pace, places = Pace(), []
    for i in range(1, 21):
        pace = next_pace(pace, 0.0 if i < 10 else 1.0, 0.05 * i, np.array([-0.1 * i, 0.0, 0.0]))
        places.append(slowed(far, pace, 2.0).position[0])
    assert places[:9] == [pytest.approx(-0.1)] * 9
    assert places[9] == pytest.approx(1.5)  # after a short gap, with the speed that is left
    stood = next_pace(Pace(0.0, 0.0, 0.0, 1.0, np.zeros(3)), 1.0, 1.05, np.zeros(3))
    assert 0.0 < slowed(far, stood, 2.0).position[0] < 0.2


def test_hold_after_a_stand_keeps_the_standing_place():
    state, _ = fly(orbiting(), seen(subject_age_s=0.35), 0.2, 1.0)
    moved = seen(subject_age_s=1.1, position=GOOD.vehicle.position + 0.5)
    late, _ = reduce(state, moved, 1.2, None, LIMITS)
    assert np.array_equal(late.position, GOOD.vehicle.position)
    stopped, _ = reduce(state, moved, 1.2, Command.STOP, LIMITS)
    assert np.array_equal(stopped.position, moved.vehicle.position)


@pytest.mark.parametrize("name", OLD)
def test_orbit_ends_beyond_the_longest_gap_and_never_resumes_by_itself(name):
    state, _ = reduce(orbiting(), seen(**OLD[name]), 1.0, None, LIMITS)
    assert state.state == State.HOLDING
    state, actions = fly(state, GOOD, 9.0, 1.05)
    assert set(actions) == {Action.HOLD}


def test_pictures_of_something_else_are_no_late_picture():
    other = seen(subject_age_s=0.45, subject_contradicted=True)
    assert reduce(orbiting(), other, 1.0, None, LIMITS)[0].state == State.HOLDING
    assert reduce(orbiting(), seen(subject_age_s=0.45), 1.0, None, LIMITS)[0].state == State.ORBITING


@pytest.mark.parametrize("name", [*OLD, *NOT_HARMLESS])
def test_start_needs_what_an_orbit_at_full_speed_needs(name):
    values = {**OLD, "attitude": {"state_age_s": 0.25}, "position": {"position_age_s": 0.25},
              "late picture": {"subject_age_s": 0.45}, **NOT_HARMLESS}[name]  # fmt: skip
    state, _ = reduce(orbiting(), GOOD, 1.0, Command.STOP, LIMITS)
    state, decision = reduce(state, seen(**values), 1.3, Command.START, LIMITS)
    assert state.state == State.HOLDING
    assert not decision.answer.accepted


def in_hold_mode():
    state, _ = reduce(orbiting(), GOOD, 1.0, Command.STOP, LIMITS)
    state = permit_mode(state, "BRAKE")
    state, decision = reduce(state, BRAKE, 3.0, None, LIMITS)
    assert (state.state, decision.action) == (State.HOLDING, Action.NOTHING)
    return state


def test_starting_again_after_a_hold_is_one_command():
    # Still in GUIDED: start.
    state, _ = reduce(orbiting(), GOOD, 1.0, Command.STOP, LIMITS)
    state, decision = reduce(state, GOOD, 1.2, Command.START, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    # In the hold mode: engage.
    state, decision = reduce(in_hold_mode(), BRAKE, 5.0, Command.ENGAGE, LIMITS)
    assert decision.mode_request == ModeRequest.CONTROL
    state, decision = reduce(permit_mode(state, "GUIDED"), GOOD, 5.3, None, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    # The pilot gives control back: nothing is sent until start.
    state, actions = fly(in_hold_mode(), GOOD, 2.0, 5.0)
    assert set(actions) == {Action.NOTHING}
    assert state.state == State.READY
    state, decision = reduce(state, GOOD, 8.0, Command.START, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    # Another mode of the pilot stays a take-over.
    state, _ = reduce(in_hold_mode(), LOITER, 5.0, None, LIMITS)
    assert state.state == State.TAKEN_OVER


@pytest.mark.parametrize("name", OLD)
def test_gap_of_data_while_control_is_requested_delays_the_orbit(name):
    gap = {
        "late picture": {"subject_age_s": 0.5},
        "attitude": {"state_age_s": 0.3},
        "position": {"position_age_s": 0.3},
    }
    state, decision = reduce(in_hold_mode(), BRAKE, 5.0, Command.ENGAGE, LIMITS)
    assert decision.answer.accepted
    state, decision = reduce(permit_mode(state, "GUIDED"), seen(**gap[name]), 5.1, None, LIMITS)
    assert (state.state, decision.action) == (State.READY, Action.HOLD)
    assert reduce(state, GOOD, 5.2, None, LIMITS)[0].state == State.ORBITING
    # Control is granted: what ends the request ends in a hold, not in silence.
    ended, decision = reduce(state, seen(**OLD[name]), 5.2, None, LIMITS)
    assert (ended.state, decision.action) == (State.HOLDING, Action.HOLD)


@pytest.mark.parametrize("command", [Command.START, Command.ENGAGE])
def test_start_while_our_own_hold_mode_is_on_its_way_is_refused_and_the_mode_is_no_take_over(command):
    state, _ = reduce(orbiting(), GOOD, 1.0, Command.STOP, LIMITS)
    state, _ = fly(state, GOOD, 1.5, 1.05)
    state = permit_mode(state, "BRAKE")  # as with the request
    state, decision = reduce(state, GOOD, 2.6, command, LIMITS)
    assert not decision.answer.accepted
    assert decision.answer.condition.code == ConditionCode.HOLD_MODE_PENDING
    state, _ = reduce(state, BRAKE, 2.65, None, LIMITS)
    assert state.state == State.HOLDING
    state, decision = reduce(state, BRAKE, 2.7, Command.ENGAGE, LIMITS)
    assert decision.answer.accepted


def test_slowed_setpoint_scales_velocity_and_stands_without_acceleration():
    full = Setpoint(np.ones(3), np.array([2.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.0]), 1.0, 0.3)
    assert slowed(full, Pace(), 2.0) is full
    half = slowed(full, Pace(0.5, -0.6, 0.9, 0.0), 2.0)
    assert np.allclose(half.velocity, [1.0, 0.0, 0.0])
    assert np.allclose(half.acceleration, [-1.2, 0.15, 0.0])
    assert half.yaw_rate == pytest.approx(0.15)
    still = slowed(full, Pace(0.0, -0.6, 0.5, 0.0), 2.0)
    assert not still.velocity.any()
    assert not still.acceleration.any()
    assert np.array_equal(still.position, full.position)
    assert np.linalg.norm(slowed(full, Pace(0.9, -0.6, 0.9, 0.0), 0.5).acceleration) == pytest.approx(0.5)


@pytest.mark.parametrize("most_m", [0.2, 1.5, 10.0])
def test_the_reference_waits_the_longer_the_further_the_vehicle_lags_behind(most_m):
    shares = np.array([waiting(lead * most_m, most_m) for lead in np.linspace(0.0, 3.0, 61)])
    assert (shares[:11] == 1.0).all()  # behind by half of the greatest lead: as every vehicle flies
    assert (np.diff(shares, axis=0) <= 0.0).all()
    assert shares[20].tolist() == [0.0, 1.0]
    assert shares[-1].tolist() == [0.0, 0.0]
