"""The closed loop in simulated time, with the flown link, estimator, planner and safety."""

import random

import numpy as np
import pytest

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Action, Command, OperatorCommand, State
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, orbit_quality, with_config

WIND = (8.0, 0.0, 0.0)


def _missed(autopilot: str, action: str):
    """A case whose radius the truer simulated vehicles miss; the bound of 0.3 m stays."""
    reason = "radius error above 0.3 m in wind since the simulated vehicles fly and report as the recorded ones"
    return pytest.param(autopilot, action, marks=pytest.mark.xfail(reason=reason, strict=True))


@pytest.mark.parametrize(
    ("autopilot", "action"),
    [
        ("ardupilot", "stand"), ("px4", "stand"), _missed("ardupilot", "walk"), _missed("px4", "walk"),
    ],
)  # fmt: skip
def test_orbit_in_wind_keeps_radius_heading_and_distance(autopilot, action):
    settings = LoopSettings(autopilot=autopilot, action=action, wind_m_s=WIND, seed=2, seconds=32)
    loop = OrbitLoop(with_config(settings, body_height_m=1.75))  # the other parameters have their defaults
    loop.start()
    loop.run(31.0)
    quality = orbit_quality(loop, 6.0, 13.0)
    assert quality.orbiting == 1.0, loop.reasons[-3:]
    assert quality.radius_error_m <= 0.3
    assert quality.yaw_error_deg <= 3.0
    assert quality.in_middle_third >= 0.95
    assert quality.least_distance_m > 3.0


@pytest.mark.xfail(reason="the gate refuses a squat seen from 56 degrees above: the orbit holds after 2 s", strict=True)
def test_narrow_high_orbit_of_a_squatting_person_keeps_the_distance():
    # With a camera tilted down by 55 degrees the estimated distance was once 5 m where the true one was 3 m.
    settings = LoopSettings(
        autopilot="px4", action="squats", seed=523, stature_m=1.82, distance_m=4.3, height_m=5.0, latency_s=0.12,
        wind_m_s=(0.9, -2.2, 0.0), bearing_deg=-157.0, seconds=25,
    )  # fmt: skip
    loop = OrbitLoop(with_config(settings, radius_m=3.9, height_m=5.9, angular_speed_deg_s=-19.0, body_height_m=1.8))
    loop.start()
    loop.run(24.0)
    rows = [row for row in loop.rows if row.t_s > 6.0]
    assert all(row.state == State.ORBITING for row in rows), loop.reasons[-2:]
    assert min(row.distance_m for row in rows) > 3.0
    assert np.mean([row.distance_m for row in rows if row.t_s > 14.0]) < 4.6


def test_same_flight_is_bit_identical():
    ends = []
    for _ in range(2):
        loop = OrbitLoop(LoopSettings(seed=5, seconds=9, wind_m_s=(3.0, 1.0, 0.0)))
        loop.start()
        loop.run(8.0)
        ends.append(np.array([row.position for row in loop.rows]))
    assert np.array_equal(*ends)


def test_an_orbit_ends_at_its_longest_time_and_starts_again():
    loop = OrbitLoop(with_config(LoopSettings(seconds=30), max_orbit_s=5.0))
    loop.start()
    loop.run(15.0)
    held_s, state, condition = loop.reasons[-1]
    assert (state, condition.code) == ("HOLDING", ConditionCode.ORBIT_TIME_OVER)
    assert 9.0 <= held_s < 9.2
    loop.command(Command.ENGAGE)
    loop.run(17.0)
    assert loop.controller.safety.state == State.ORBITING


@pytest.mark.parametrize("late_s", [0.0, 5.0])
def test_without_a_sign_of_the_operator_no_orbit_begins_and_one_that_is_flown_holds(late_s):
    loop = OrbitLoop(with_config(LoopSettings(seconds=30), operator_timeout_s=1.5))
    loop.start()
    loop.run(4.5)
    assert loop.answers[-1][1].condition.code == ConditionCode.OPERATOR_SILENT

    def sign(loop):
        stamp_ns = loop.clock_ns() - round(late_s * 1e9)
        loop.controller.command(OperatorCommand(int(Command.PRESENT), stamp_ns=stamp_ns))

    loop.run(6.0, sign)
    loop.command(Command.START)
    loop.run(10.0, sign)
    assert loop.controller.safety.state == (State.IDLE if late_s else State.ORBITING)  # an old sign is none
    loop.run(12.0)
    held_s, _, condition = loop.reasons[-1]
    assert condition.code == ConditionCode.OPERATOR_SILENT
    assert late_s or 11.4 <= held_s <= 11.6


def test_engage_without_permission_is_refused_and_no_setpoint_is_sent():
    settings = LoopSettings(seconds=8, start_mode="LOITER")
    loop = OrbitLoop(with_config(settings, mode_change_allowed=False))
    loop.start()
    loop.run(7.0)
    assert [(a.accepted, a.condition.code) for _, a in loop.answers] == [(False, ConditionCode.MODE_CHANGE_FORBIDDEN)]
    assert loop.copter.mode == "LOITER"
    assert "SET_POSITION_TARGET_LOCAL_NED" not in loop.copter.received


def test_start_adjust_stop_and_second_start_are_answered():
    loop = OrbitLoop(LoopSettings(seconds=60, seed=1))
    loop.start()
    loop.run(12.0)
    loop.command(Command.ADJUST, radius_m=8.0)
    loop.command(Command.ADJUST, radius_m=1.0)
    loop.run(24.0)
    assert abs(loop.rows[-1].distance_m - 8.0) < 0.6
    loop.command(Command.STOP)
    loop.run(30.0)
    assert loop.controller.safety.state == State.HOLDING
    assert loop.copter.mode == "BRAKE"
    assert np.linalg.norm(loop.rows[-1].velocity) < 0.3
    loop.command(Command.START)
    loop.run(30.2)
    loop.command(Command.ENGAGE)
    loop.run(33.0)
    assert loop.controller.safety.state == State.ORBITING
    assert [(a.accepted, a.condition.code) for _, a in loop.answers[:5]] == [
        (True, ConditionCode.ORBITING), (True, ConditionCode.ADJUSTED), (False, ConditionCode.RADIUS_TOO_SMALL),
        (True, ConditionCode.STOPPED), (False, ConditionCode.NOT_IN_CONTROL_MODE),
    ]  # fmt: skip


@pytest.mark.parametrize(("radius_m", "code"), [(4.0, ConditionCode.WIDENED), (6.0, ConditionCode.ORBITING)])
def test_status_names_the_radius_that_is_flown_instead_of_a_small_one(radius_m, code):
    """A 4 m orbit was flown at 4.7 m, and nothing said so."""
    loop = OrbitLoop(with_config(LoopSettings(seconds=16), radius_m=radius_m, angular_speed_deg_s=10.0))
    loop.start()
    loop.run(14.0)
    assert loop.status.condition.code == code
    assert ("4.7 m away instead of 4.0" in str(loop.status.condition)) == (code == ConditionCode.WIDENED)
    if code == ConditionCode.WIDENED:
        assert loop.rows[-1].distance_m == pytest.approx(4.7, abs=0.5)


def test_random_and_mutated_packets_cause_no_motion():
    chance = random.Random(11)
    loop = OrbitLoop(LoopSettings(seconds=12, seed=3))
    received = []
    loop.run(2.0)
    read = loop.down.read
    loop.down.read = lambda: received.append(read()) or received[-1]

    def disturb(loop):
        for _ in range(5):
            packet = bytearray(chance.choice(received[-50:]) or b"\xfd") if chance.random() < 0.6 else bytearray(
                chance.randbytes(chance.randrange(1, 300))
            )  # fmt: skip
            for _ in range(chance.randrange(0, 4)):
                packet[chance.randrange(len(packet))] ^= 1 << chance.randrange(8)
            loop.down.write(bytes(packet))

    loop.run(10.0, disturb)
    assert all(row.action == Action.NOTHING for row in loop.rows)
    assert "SET_POSITION_TARGET_LOCAL_NED" not in loop.copter.received
    assert loop.link.status().bad_count > 0


def test_invalid_commands_are_refused_and_cause_no_motion():
    chance = random.Random(12)
    loop = OrbitLoop(LoopSettings(seconds=12, seed=3))
    odd = [float("nan"), float("inf"), -float("inf"), 0.0, -1e30, 1e30, 5.0]

    def disturb(loop):
        for _ in range(10):
            kind = chance.choice([*range(4, 256), -1])
            values = [chance.choice(odd) for _ in range(3)]
            loop.controller.command(OperatorCommand(kind, *values, chance.choice([0, 1, 2**62])))
            old = loop.clock_ns() - chance.randrange(3, 10**6) * 10**9
            loop.controller.command(OperatorCommand(chance.randrange(1, 4), stamp_ns=old))
            loop.controller.command(OperatorCommand(1, radius_m=chance.choice([-1.0, 0.0, float("inf"), 1e30])))

    loop.run(10.0, disturb)
    assert all(row.action == Action.NOTHING for row in loop.rows)
    assert loop.answers
    assert not any(answer.accepted for _, answer in loop.answers)
    assert "SET_POSITION_TARGET_LOCAL_NED" not in loop.copter.received
