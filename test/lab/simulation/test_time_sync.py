"""The simulated vehicle answers TIMESYNC as a real one does: with a time at which it had the question."""

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.mavlink.parser import MavlinkParser
from drocap_ros.simulation.vehicle.copter import SimulatedCopter
from lab.simulation.path_vehicle import PathVehicle, orbit_path

ARRIVES_S = 1.3
QUESTION = mavlink.MAVLink(None, srcSystem=255).timesync_encode(0, 7)


class BusyMachine:
    """A transport on which a read takes until the question comes, much longer than it may wait."""

    def __init__(self):
        self.now_s, self.sent = 0.0, b""

    def read(self, timeout_s):
        if self.now_s >= ARRIVES_S:
            self.now_s += 0.01
            return b""
        self.now_s = ARRIVES_S
        return QUESTION.pack(mavlink.MAVLink(None, srcSystem=255))

    def write(self, data):
        self.sent += data
        return True

    def accept_peer(self):
        pass

    def close(self):
        pass


def answers_of(machine):
    return [m for m in MavlinkParser().feed(machine.sent) if m.get_type() == "TIMESYNC"]


def test_an_answer_is_not_stamped_before_its_question_arrived():
    """On a busy machine it was, by 0.02 s, and counted as a step of the clock."""
    machine = BusyMachine()
    with PathVehicle(machine, orbit_path(60), boot_s=30.0) as vehicle:
        vehicle.run(lambda: machine.now_s, seconds=1.5)
    answers = answers_of(machine)
    assert [m.ts1 for m in answers] == [7]
    assert answers[0].tc1 >= (30.0 + ARRIVES_S) * 1e9


def test_a_question_that_arrives_while_the_copter_computes_its_flight_is_answered_at_the_next_step():
    machine = BusyMachine()
    machine.read = lambda _: b""
    copter = SimulatedCopter(machine, np.array([6.0, 0.0, 2.5]), 0.0)
    move = copter._move

    def asked(dt):
        machine.read = BusyMachine.read.__get__(machine)
        move(dt)

    copter._move = asked
    copter.fly(0.01)
    assert answers_of(machine) == []
    copter.fly(0.02)
    assert [m.ts1 for m in answers_of(machine)] == [7]
