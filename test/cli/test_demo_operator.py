"""The demo's operator, told what the bridge would say."""

import pytest

from drocap_ros.cli.demo.flight import check_flown
from drocap_ros.cli.demo.operator import READY_TIMEOUT_S, Operator, Phase
from drocap_ros.errors import NodeError
from drocap_ros.flight.orbit.safety import Command, State


class Desk:
    """Statuses five times a second; what the operator commands is what ``bridge`` makes of it."""

    def __init__(self, operator):
        self.operator, self.t, self.commands = operator, 100.0, []

    def show(self, state, reason, seconds=0.2):
        end = self.t + seconds
        while self.t < end - 1e-9:
            command = self.operator.look(state, reason, self.t)
            if command is not None:
                self.commands.append((round(self.t - 100.0, 1), command))
            self.t += 0.2


def test_it_waits_starts_watches_and_stops():
    operator = Operator(5.0)
    desk = Desk(operator)
    desk.show(State.IDLE, "the motors are not armed", 3.0)
    assert desk.commands == []
    desk.show(State.READY, "all conditions for motion hold", 0.8)
    desk.show(State.IDLE, "the subject was last located 0.5 s ago")
    desk.show(State.READY, "all conditions for motion hold", 1.0)
    assert desk.commands == []
    desk.show(State.READY, "all conditions for motion hold", 0.4)
    assert [command for _, command in desk.commands] == [Command.START]
    desk.show(State.ORBITING, "orbiting the subject", 6.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.STOP]
    assert operator.orbited_s == pytest.approx(5.0, abs=0.3)
    desk.show(State.HOLDING, "stopped by the operator", 2.0)
    assert not operator.over
    desk.show(State.HOLDING, "stopped by the operator", 3.0)
    assert operator.phase == Phase.DONE
    assert operator.holds == []
    check_flown(operator)


def test_px4_is_asked_for_control_from_the_start():
    desk = Desk(Operator(5.0, takes_control=True))
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    assert [command for _, command in desk.commands] == [Command.ENGAGE]


def test_nothing_is_started_before_the_pilot_has_handed_over():
    operator = Operator(5.0, cleared=False)
    desk = Desk(operator)
    desk.show(State.READY, "all conditions for motion hold", 3.0)
    assert desk.commands == []
    operator.cleared = True
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    assert [command for _, command in desk.commands] == [Command.START]


def test_a_refused_start_is_tried_again_later():
    desk = Desk(Operator(5.0))
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    desk.show(State.READY, "refused: the mode is LOITER; switch to GUIDED or OFFBOARD, or send engage")
    desk.show(State.READY, "all conditions for motion hold", 6.0)
    times = [t for t, command in desk.commands if command == Command.START]
    assert len(times) == 2
    assert times[1] - times[0] >= 2.0


def test_after_a_hold_the_orbit_is_started_again_with_control_asked_for_and_its_time_goes_on():
    operator = Operator(6.0, restarts=2)
    desk = Desk(operator)
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    desk.show(State.ORBITING, "orbiting the subject", 4.0)
    desk.show(State.HOLDING, "the subject was last located 0.5 s ago", 4.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.ENGAGE]
    assert desk.commands[1][0] - 4.2 >= 3.0
    desk.show(State.READY, "asking the autopilot for control", 1.0)
    desk.show(State.ORBITING, "orbiting the subject", 3.0)
    assert desk.commands[-1][1] == Command.STOP
    assert operator.holds == ["the subject was last located 0.5 s ago"]
    assert operator.orbited_s == pytest.approx(6.0, abs=0.5)


def test_too_many_holds_end_the_flight():
    operator = Operator(60.0, restarts=1)
    desk = Desk(operator)
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    for _ in range(2):
        desk.show(State.ORBITING, "orbiting the subject", 2.0)
        desk.show(State.HOLDING, "the link's round trip takes 0.9 s", 4.0)
    assert operator.phase == Phase.GIVEN_UP
    assert "2 times" in operator.failure
    assert desk.commands[-1][1] == Command.STOP
    with pytest.raises(NodeError, match=r"expected 60 s of orbit, flew 3\.\d s: .*round trip"):
        check_flown(operator)


def test_a_pilot_who_takes_over_ends_the_flight():
    operator = Operator(60.0)
    desk = Desk(operator)
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    desk.show(State.ORBITING, "orbiting the subject", 2.0)
    desk.show(State.TAKEN_OVER, "the mode became LOITER by another hand", 1.0)
    assert operator.failure == "the mode became LOITER by another hand"


def test_a_fault_is_acknowledged_before_the_next_start():
    desk = Desk(Operator(60.0))
    desk.show(State.READY, "all conditions for motion hold", 1.2)
    desk.show(State.ORBITING, "orbiting the subject", 2.0)
    desk.show(State.FAULT, "the autopilot's hold mode does not come: take over by hand", 4.0)
    desk.show(State.READY, "all conditions for motion hold", 4.0)
    assert [command for _, command in desk.commands] == [Command.START, Command.STOP, Command.ENGAGE]


def test_a_bridge_that_never_gets_ready_is_given_up():
    operator = Operator(60.0)
    Desk(operator).show(State.IDLE, "no subject is tracked", READY_TIMEOUT_S + 1)
    assert operator.phase == Phase.GIVEN_UP
    assert "no subject is tracked" in operator.failure


def test_words_are_not_repeated_for_every_number_in_them():
    operator = Operator(60.0)
    desk = Desk(operator)
    for tenth in range(20):
        desk.show(State.IDLE, f"the subject was last located 0.{tenth} s ago")
    assert operator.said == ["not ready yet: the subject was last located 0.0 s ago"]
