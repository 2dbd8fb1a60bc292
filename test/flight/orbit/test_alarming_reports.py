"""What the autopilot reports of itself: an emergency, a critical state, several vehicles."""

import math

from orbit_observations import GOOD, LIMITS, LOITER, changed, orbiting

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.telemetry_request import LinkStatus
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Action, Command, Idle, ModeRequest, State

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
