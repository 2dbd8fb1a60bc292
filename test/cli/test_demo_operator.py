"""The demo's operator with statuses and answers as the bridge would send them."""

import pytest

from drocap_ros.cli.demo.flight import check_flown
from drocap_ros.cli.demo.operator import READY_TIMEOUT_S, Operator, Phase
from drocap_ros.errors import NodeError
from drocap_ros.flight.conditions import ConditionCode, condition
from drocap_ros.flight.orbit.states import Command, State

NOT_ARMED = condition(ConditionCode.NOT_ARMED)
CLEAR = condition(ConditionCode.ALL_CLEAR)
ORBITING = condition(ConditionCode.ORBITING)
NO_SUBJECT = condition(ConditionCode.NO_SUBJECT)
LOST = condition(ConditionCode.SUBJECT_OUTDATED, age_s=0.5)
LATE = condition(ConditionCode.ROUND_TRIP_TOO_LONG, age_s=0.9)
STOPPED = condition(ConditionCode.STOPPED)
REQUESTING = condition(ConditionCode.REQUESTING_CONTROL)
TAKEN = condition(ConditionCode.PILOT_TOOK_OVER, mode="LOITER")
NO_HOLD = condition(ConditionCode.HOLD_MODE_MISSING, cause=LOST)


class Desk:
    """Statuses five times a second; records the operator's commands with their times."""

    def __init__(self, operator):
        self.operator, self.t, self.commands = operator, 100.0, []

    def answer(self, accepted, reason):
        self.operator.on_answer(accepted, reason.code, str(reason), self.t)

    def show(self, state, reason, seconds=0.2):
        end = self.t + seconds
        while self.t < end - 1e-9:
            command = self.operator.on_status(state, reason.code, str(reason), self.t)
            if command is not None:
                self.commands.append((round(self.t - 100.0, 1), command))
            self.t += 0.2


def test_operator_starts_a_ready_bridge_and_stops_after_the_wanted_time():
    operator = Operator(5.0)
    desk = Desk(operator)
    desk.show(State.IDLE, NOT_ARMED, 3.0)
    assert desk.commands == []
    desk.show(State.READY, CLEAR, 0.8)
    desk.show(State.IDLE, LOST)
    desk.show(State.READY, CLEAR, 1.0)
    assert desk.commands == []
    desk.show(State.READY, CLEAR, 0.4)
    assert [command for _, command in desk.commands] == [Command.START]
    desk.show(State.ORBITING, ORBITING, 6.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.STOP]
    assert operator.orbited_s == pytest.approx(5.0, abs=0.3)
    desk.show(State.HOLDING, STOPPED, 2.0)
    assert not operator.over
    desk.show(State.HOLDING, STOPPED, 3.0)
    assert operator.phase == Phase.DONE
    assert operator.holds == []
    check_flown(operator)


def test_control_is_requested_from_px4_at_the_first_start():
    desk = Desk(Operator(5.0, requests_control=True))
    desk.show(State.READY, CLEAR, 1.2)
    assert [command for _, command in desk.commands] == [Command.ENGAGE]


def test_nothing_is_started_before_the_pilot_has_handed_over():
    operator = Operator(5.0, cleared=False)
    desk = Desk(operator)
    desk.show(State.READY, CLEAR, 3.0)
    assert desk.commands == []
    operator.cleared = True
    desk.show(State.READY, CLEAR, 1.2)
    assert [command for _, command in desk.commands] == [Command.START]


def test_refused_start_is_repeated_after_a_pause():
    desk = Desk(Operator(5.0))
    desk.show(State.READY, CLEAR, 1.2)
    desk.answer(False, condition(ConditionCode.NOT_IN_CONTROL_MODE, mode="LOITER", by_hand=""))
    desk.show(State.READY, CLEAR, 6.0)
    times = [t for t, command in desk.commands if command == Command.START]
    assert len(times) == 2
    assert times[1] - times[0] >= 2.0


def test_start_after_a_hold_requests_control_and_the_time_of_orbit_continues():
    operator = Operator(6.0, restarts=2)
    desk = Desk(operator)
    desk.show(State.READY, CLEAR, 1.2)
    desk.show(State.ORBITING, ORBITING, 4.0)
    desk.show(State.HOLDING, LOST, 4.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.ENGAGE]
    assert desk.commands[1][0] - 4.2 >= 3.0
    desk.show(State.READY, REQUESTING, 1.0)
    desk.show(State.ORBITING, ORBITING, 3.0)
    assert desk.commands[-1][1] == Command.STOP
    assert operator.holds == [str(LOST)]
    assert operator.orbited_s == pytest.approx(6.0, abs=0.5)


def test_too_many_holds_end_the_flight():
    operator = Operator(60.0, restarts=1)
    desk = Desk(operator)
    desk.show(State.READY, CLEAR, 1.2)
    for _ in range(2):
        desk.show(State.ORBITING, ORBITING, 2.0)
        desk.show(State.HOLDING, LATE, 4.0)
    assert operator.phase == Phase.GIVEN_UP
    assert "2 times" in operator.failure
    assert desk.commands[-1][1] == Command.STOP
    with pytest.raises(NodeError, match=r"expected 60 s of orbit, flew 3\.\d s: .*answered nothing"):
        check_flown(operator)


def test_take_over_by_the_pilot_ends_the_flight():
    operator = Operator(60.0)
    desk = Desk(operator)
    desk.show(State.READY, CLEAR, 1.2)
    desk.show(State.ORBITING, ORBITING, 2.0)
    desk.show(State.TAKEN_OVER, TAKEN, 1.0)
    assert operator.failure == str(TAKEN)


def test_a_fault_is_acknowledged_before_the_next_start():
    desk = Desk(Operator(60.0))
    desk.show(State.READY, CLEAR, 1.2)
    desk.show(State.ORBITING, ORBITING, 2.0)
    desk.show(State.FAULT, NO_HOLD, 4.0)
    desk.show(State.READY, CLEAR, 4.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.STOP, Command.ENGAGE]


def test_bridge_that_is_never_ready_is_given_up():
    operator = Operator(60.0)
    Desk(operator).show(State.IDLE, NO_SUBJECT, READY_TIMEOUT_S + 1)
    assert operator.phase == Phase.GIVEN_UP
    assert "no subject is tracked" in operator.failure


def test_remark_with_new_numbers_but_the_same_code_is_not_repeated():
    operator = Operator(60.0)
    desk = Desk(operator)
    for tenth in range(20):
        desk.show(State.IDLE, condition(ConditionCode.SUBJECT_OUTDATED, age_s=0.1 * tenth))
    assert operator.remarks == ["not ready yet: the subject was last located 0.0 s ago"]
