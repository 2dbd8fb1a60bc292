"""Whose mode it is: the pilot's, the autopilot's own, or one that was requested."""

import dataclasses
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from orbit_observations import GOOD, LIMITS, LOITER, changed, orbiting

from drocap_ros.flight.autopilot.autopilot import LossSettings
from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.telemetry_request import LinkStatus
from drocap_ros.flight.orbit.safety import permit_mode, reduce
from drocap_ros.flight.orbit.states import Action, Command, Idle, ModeRequest, State

PX4 = changed(GOOD, autopilot="px4", mode="OFFBOARD", heard=frozenset({"OFFBOARD"}))
HOLD = changed(PX4, mode="LOITER", heard=frozenset({"LOITER"}), in_control=False, in_hold=True)
FAILSAFE = changed(HOLD, left_by_itself=True)


def engaged(seen):
    state, _ = reduce(Idle(), seen, 0.0, None, LIMITS)
    state, decision = reduce(state, seen, 0.1, Command.ENGAGE, LIMITS)
    assert decision.answer.accepted
    return state


def test_a_mode_that_was_heard_between_two_steps_is_a_take_over():
    state, decision = reduce(orbiting(), changed(GOOD, heard=frozenset({"GUIDED", "RTL"})), 1.0, None, LIMITS)
    assert (state.state, decision.action) == (State.TAKEN_OVER, Action.NOTHING)
    assert state.condition.values["mode"] == "RTL"


def test_control_that_the_stream_restores_while_it_is_requested_is_no_take_over():
    state = engaged(FAILSAFE)
    state, decision = reduce(state, PX4, 0.2, None, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    pilot = changed(PX4, mode="POSCTL", heard=frozenset({"POSCTL"}), in_control=False)
    state, decision = reduce(engaged(FAILSAFE), pilot, 0.2, None, LIMITS)
    assert (state.state, decision.action) == (State.TAKEN_OVER, Action.NOTHING)


def test_the_autopilots_own_hold_is_not_called_the_pilots_and_engage_follows_it():
    state, decision = reduce(orbiting(PX4), FAILSAFE, 1.0, None, LIMITS)
    assert (state.state, decision[:2]) == (State.HOLDING, (Action.NOTHING, ModeRequest.NONE))
    assert state.condition.code == ConditionCode.SETPOINTS_NOT_FOLLOWED
    assert "by itself" in state.reason
    state, decision = reduce(state, FAILSAFE, 2.0, Command.ENGAGE, LIMITS)
    assert (decision.answer.accepted, decision.action) == (True, Action.HOLD)


def test_another_failsafe_ends_the_commands_too():
    landing = changed(FAILSAFE, mode="LAND", heard=frozenset({"LAND"}), in_hold=False)
    state, decision = reduce(orbiting(PX4), landing, 1.0, None, LIMITS)
    assert (state.state, decision.action) == (State.TAKEN_OVER, Action.NOTHING)
    assert state.condition.code == ConditionCode.SETPOINTS_NOT_FOLLOWED


def test_the_words_follow_when_the_intention_is_reported_after_the_mode():
    state, _ = reduce(orbiting(PX4), HOLD, 1.0, None, LIMITS)
    assert (state.state, state.condition.code) == (State.TAKEN_OVER, ConditionCode.PILOT_TOOK_OVER)
    state, decision = reduce(state, FAILSAFE, 1.1, None, LIMITS)
    assert (state.state, decision.action) == (State.HOLDING, Action.NOTHING)
    state, _ = reduce(orbiting(PX4), HOLD, 1.0, None, LIMITS)
    assert reduce(state, HOLD, 1.1, None, LIMITS)[0].state == State.TAKEN_OVER


@pytest.mark.parametrize("timeout_s", [0.5, 3.0])
@pytest.mark.parametrize("seen", [GOOD, PX4])
def test_a_stream_that_was_interrupted_does_not_resume_by_itself(seen, timeout_s):
    seen = changed(seen, loss_settings=LossSettings("", timeout_s, "", 5))
    limits = dataclasses.replace(LIMITS, max_control_timeout_s=3.0)
    state, decision = reduce(orbiting(), GOOD, 1.0, Command.STOP, limits)
    assert decision.action == Action.HOLD
    state = permit_mode(state, seen.mode.name)
    for i in range(1, 400):
        t = 1.0 + timeout_s + 0.05 * i
        state, decision = reduce(state, changed(seen, stream_gap_s=timeout_s + 0.05 * i), t, None, limits)
        assert decision[:2] == (Action.NOTHING, ModeRequest.NONE)
        assert state.state == State.HOLDING
    state, decision = reduce(state, changed(seen, stream_gap_s=30.0), t + 0.1, Command.START, limits)
    assert decision.action == Action.ORBIT  # the operator commands
    short = changed(seen, stream_gap_s=timeout_s - 0.1)
    state, _ = reduce(orbiting(), GOOD, 1.0, Command.STOP, limits)
    assert reduce(permit_mode(state, seen.mode.name), short, 1.1, None, limits)[1].action == Action.HOLD


MODES = ("OFFBOARD", "LOITER", "RTL", "POSCTL", "")


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_after_a_foreign_mode_nothing_is_sent_until_the_operator_commands(seed):
    chance = random.Random(seed)
    state, foreign, t = orbiting(PX4), False, 1.0
    for _ in range(chance.randint(1, 30)):
        mode, heard = chance.choice(MODES), frozenset(chance.sample(MODES, chance.choice((0, 0, 1, 2))))
        seen = changed(
            PX4, mode=mode, heard=heard | {mode}, in_control=mode == "OFFBOARD", in_hold=mode == "LOITER",
            left_by_itself=chance.random() < 0.5 and mode not in ("OFFBOARD", ""),
        )  # fmt: skip
        state, decision = reduce(state, seen, t, None, LIMITS)
        foreign |= bool((heard | {mode}) - {"OFFBOARD", ""})
        t += 0.05
        if foreign:
            assert decision[:2] == (Action.NOTHING, ModeRequest.NONE)


CRITICAL = 5


def test_every_state_of_emergency_holds_and_forbids_a_start():
    for status in (6, 7, 8):
        seen = changed(GOOD, system_status=status)
        state, decision = reduce(orbiting(), seen, 1.0, None, LIMITS)
        assert (state.state, state.condition.code) == (State.HOLDING, ConditionCode.AUTOPILOT_EMERGENCY)
        assert decision.action == Action.HOLD
        _, decision = reduce(Idle(), seen, 1.0, Command.START, LIMITS)
        assert (decision.answer.accepted, decision.answer.condition.code) == (False, state.condition.code)


def test_a_critical_state_forbids_a_start_and_ends_no_orbit():
    seen = changed(GOOD, system_status=CRITICAL)
    state, decision = reduce(orbiting(), seen, 1.0, None, LIMITS)
    assert (state.state, decision.action) == (State.ORBITING, Action.ORBIT)
    for command in (Command.START, Command.ENGAGE):
        state, decision = reduce(Idle(), seen, 1.0, command, LIMITS)
        assert (state.state, decision.answer.accepted) == (State.IDLE, False)
        assert decision.answer.condition.code == ConditionCode.AUTOPILOT_CRITICAL
    assert reduce(Idle(), changed(seen, system_status=4), 1.0, None, LIMITS)[0].state == State.READY


def test_a_critical_state_of_the_failsafe_for_lost_setpoints_alone_lets_an_orbit_begin():
    own = changed(LOITER, autopilot="px4", mode="LOITER", in_hold=True, left_by_itself=True, system_status=CRITICAL)
    assert reduce(Idle(), own, 1.0, Command.ENGAGE, LIMITS)[1].answer.accepted
    for other in ({"left_by_itself": False}, {"in_hold": False}):
        answer = reduce(Idle(), changed(own, **other), 1.0, Command.ENGAGE, LIMITS)[1].answer
        assert (answer.accepted, answer.condition.code) == (False, ConditionCode.AUTOPILOT_CRITICAL)


def test_no_mode_is_requested_in_a_hold_of_the_autopilot_that_another_failsafe_may_fly():
    own = changed(LOITER, autopilot="px4", mode="LOITER", in_hold=True, left_by_itself=True, system_status=CRITICAL)
    state, decision = reduce(Idle(), own, 0.0, Command.ENGAGE, LIMITS)
    assert decision.answer.accepted
    for seen in (own, changed(own, system_status=4), changed(own, left_by_itself=False)):
        assert reduce(state, seen, 2.0, None, LIMITS)[1][:2] == (Action.HOLD, ModeRequest.NONE)
    chosen = changed(own, left_by_itself=False, system_status=4)
    assert reduce(state, chosen, 2.0, None, LIMITS)[1].mode_request == ModeRequest.CONTROL
    ended = reduce(state, own, 30.0, None, LIMITS)[0]
    assert ended.condition.code == ConditionCode.CONTROL_NOT_GRANTED
    assert "another failsafe" in str(ended.condition)


def test_several_vehicles_forbid_a_start_and_end_no_orbit():
    seen = changed(GOOD, vehicles=frozenset({1, 42}))
    assert reduce(orbiting(), seen, 1.0, None, LIMITS)[0].state == State.ORBITING
    answer = reduce(Idle(), seen, 1.0, Command.START, LIMITS)[1].answer
    assert (answer.accepted, answer.condition.code) == (False, ConditionCode.SEVERAL_VEHICLES)
    assert "systems 1, 42" in str(answer)


def test_diagnostics_warn_of_what_a_link_lacks():
    good = LinkStatus(True, 0.0, 0.02, {}, {}, 0)
    assert good.warning() == ""
    assert "time synchronization" in good._replace(round_trip_s=math.nan).warning()
    assert "refuses to send ATTITUDE" in good._replace(refused={"ATTITUDE": 2}, round_trip_s=math.nan).warning()
    assert "critical" in good._replace(critical=True).warning()
