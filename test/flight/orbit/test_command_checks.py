"""A second publisher of the keypoints, and a second bridge, by what arrives."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from orbit_observations import GOOD, LIMITS, changed, orbiting

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode
from drocap_ros.flight.orbit.command_checks import Rivals, command_condition, commanded_goal
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import Command, Idle, OperatorCommand
from lab.flights.orbit_loop import LoopSettings, OrbitLoop

CONFIG = MavlinkBridgeConfig()
NOW_NS = 1_700_000_000_000_000_000
START = int(Command.START)


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (OperatorCommand(4), ConditionCode.UNKNOWN_COMMAND),
        (OperatorCommand(255), ConditionCode.UNKNOWN_COMMAND),
        (OperatorCommand(START, stamp_ns=NOW_NS - 3_000_000_000), ConditionCode.COMMAND_OUTDATED),
        (OperatorCommand(START, stamp_ns=NOW_NS + 3_000_000_000), ConditionCode.COMMAND_OUTDATED),
        (OperatorCommand(START, stamp_ns=-1), ConditionCode.COMMAND_OUTDATED),
        (OperatorCommand(START, stamp_ns=NOW_NS - 1_000_000_000), None),
        (OperatorCommand(START), None),
    ],
)
def test_unknown_and_outdated_commands_are_refused(command, code):
    found = command_condition(command, NOW_NS)
    assert (found and found.code) == code
    assert code != ConditionCode.COMMAND_OUTDATED or "synchronize the clocks" in str(found)


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({"radius_m": math.inf}, ConditionCode.VALUE_NOT_FINITE),
        ({"height_m": -math.inf}, ConditionCode.VALUE_NOT_FINITE),
        ({"angular_speed_deg_s": math.inf}, ConditionCode.VALUE_NOT_FINITE),
        ({"radius_m": -5.0}, ConditionCode.RADIUS_TOO_SMALL),
        ({"radius_m": 0.0}, ConditionCode.RADIUS_TOO_SMALL),
        ({"radius_m": 1e30}, ConditionCode.RADIUS_TOO_LARGE),
        ({"height_m": 1e30}, ConditionCode.HEIGHT_OUT_OF_RANGE),
        ({"height_m": 1.3}, ConditionCode.HEIGHT_OUT_OF_RANGE),
        ({"angular_speed_deg_s": 1e30}, ConditionCode.SPEED_ABOVE_LIMIT),
        ({"angular_speed_deg_s": -1e30}, ConditionCode.SPEED_ABOVE_LIMIT),
        ({"angular_speed_deg_s": 40.0}, ConditionCode.ACCELERATION_ABOVE_LIMIT),
    ],
)
def test_values_outside_the_limits_are_refused(values, code):
    found = commanded_goal(CONFIG, OperatorCommand(START, **values), None)
    assert isinstance(found, Condition)
    assert found.code == code
    assert next(iter(values)) in str(found)
    # The limit that the refusal names is no value of the same refusal.
    if "limit" in found.values:
        sense = math.copysign(1.0, values.get("angular_speed_deg_s", 1.0))
        named = dict.fromkeys(values, sense * found.values["limit"])
        assert getattr(commanded_goal(CONFIG, OperatorCommand(START, **named), None), "code", None) != code


def test_radius_beyond_the_fence_is_refused():
    config = MavlinkBridgeConfig(fence_radius_m=9.0)
    present = OrbitGoal(6.0, 3.0, 0.2)
    found = commanded_goal(config, OperatorCommand(int(Command.ADJUST), radius_m=8.1), present)
    assert found.code == ConditionCode.RADIUS_TOO_LARGE
    assert "fence_radius_m" in str(found)
    allowed = commanded_goal(config, OperatorCommand(int(Command.ADJUST), radius_m=8.0), present)
    assert allowed.radius_m == pytest.approx(8.0)


@pytest.mark.parametrize("limits", [{}, {"min_distance_m": 3.1, "min_height_m": 1.1, "max_distance_m": 9.7}])
def test_limits_are_allowed_as_float32_and_what_is_beyond_is_refused(limits):
    config = dataclasses.replace(CONFIG, fence_radius_m=60.0, **limits)
    least, low = round(config.min_distance_m + 0.5, 3), round(config.min_height_m + 0.3, 3)
    high, widest = round(config.max_height_m - 0.5, 3), config.max_distance_m
    fastest = math.degrees(min(config.max_speed_m_s / widest, math.sqrt(config.max_acceleration_m_s2 / widest)))
    for name, value, step in (
        ("radius_m", least, -1e-3), ("radius_m", widest, 1e-3), ("height_m", low, -1e-3), ("height_m", high, 1e-3),
        ("angular_speed_deg_s", fastest, 1e-2),
    ):  # fmt: skip
        values = {"radius_m": widest, "angular_speed_deg_s": 5.0, name: value}
        for rounded in (value, float(np.float32(value)), float(np.nextafter(np.float32(value), np.float32(99 * step)))):
            command = OperatorCommand(START, **{**values, name: rounded})
            assert isinstance(commanded_goal(config, command, None), OrbitGoal), (name, rounded)
        beyond = commanded_goal(config, OperatorCommand(START, **{**values, name: value + step}), None)
        assert isinstance(beyond, Condition)


def test_nan_keeps_the_present_or_the_configured_value():
    present = OrbitGoal(8.0, 3.0, 0.2)
    assert commanded_goal(CONFIG, OperatorCommand(int(Command.ADJUST)), present) == pytest.approx(present)
    goal = commanded_goal(CONFIG, OperatorCommand(START, height_m=4.0), None)
    assert goal == pytest.approx((CONFIG.radius_m, 4.0, math.radians(CONFIG.angular_speed_deg_s)))


def answers_of(commands):
    loop = OrbitLoop(LoopSettings(seconds=3))
    loop.run(1.0)
    for command in commands:
        loop.controller.command(command)
    found = []
    for i in range(len(commands) + 1):
        found += loop.controller.step(loop.clock_ns() + i, loop.t + 0.001 * i).answers
    return found


def test_a_second_start_names_the_command_that_changes_its_values():
    seen = changed(GOOD, mode="LOITER", in_control=False)
    allowed = dataclasses.replace(LIMITS, mode_change_allowed=True)
    requesting = reduce(Idle(), seen, 1.0, Command.ENGAGE, allowed)[0]
    for state, now, word in ((orbiting(), GOOD, "adjust"), (requesting, seen, "stop")):
        answer = reduce(state, now, 1.1, Command.ENGAGE, allowed)[1].answer
        assert answer.accepted
        assert word in str(answer)


def test_every_command_gets_exactly_one_answer():
    commands = [OperatorCommand(kind) for kind in (1, 2, 9, 1, 3)]
    found = answers_of(commands)
    assert [command for command, _ in found] == commands
    assert all(found[i][0] is commands[i] for i in range(len(commands)))


def test_stop_precedes_all_waiting_commands_and_is_never_dropped():
    stop = OperatorCommand(int(Command.STOP))
    commands = [OperatorCommand(START), stop, *(OperatorCommand(START) for _ in range(40))]
    found = answers_of(commands)
    assert len(found) == len(commands)
    codes = [answer.condition.code for _, answer in found]
    assert codes.count(ConditionCode.TOO_MANY_COMMANDS) == 26
    assert codes.count(ConditionCode.OVERRULED_BY_STOP) == 15
    (answer,) = (answer for command, answer in found if command is stop)
    assert answer.accepted


def code(rivals, now_s):
    found = rivals.condition(now_s)
    return None if found is None else found.code


def played(*streams, until_s=4.0):
    """Rivals after the messages (rate Hz, first number, since s) of some publishers, and when they were found."""
    rivals, first_s = Rivals("/drocap"), None
    arrivals = sorted(
        (since + k / rate, first + k) for rate, first, since in streams for k in range(int((until_s - since) * rate))
    )
    for at, number in arrivals:
        rivals.take_pose2d(number, at)
        if first_s is None and rivals.condition(at) is not None:
            first_s = at
    return rivals, first_s


def test_one_publisher_is_alone_also_when_messages_are_lost_or_it_is_restarted():
    assert played((30, 1, 0.0))[1] is None
    rivals = Rivals("/drocap")
    numbers = [*range(1, 50), *range(70, 100), *range(1, 60)]  # a gap, a restart
    for at, number in enumerate(numbers):
        rivals.take_pose2d(number, at / 30)
        assert rivals.condition(at / 30) is None


@pytest.mark.parametrize(
    ("rate", "first", "bound_s"), [(30, 1, 0.15), (12, 1000, 0.3), (30, 31, 0.15), (2, 1, 1.1), (1, 500, 2.0)]
)
def test_a_second_publisher_is_found_within_two_seconds(rate, first, bound_s):
    rivals, found_s = played((30, 1, 0.0), (rate, first, 1.0))
    assert 0 <= found_s - 1.0 <= bound_s
    assert code(rivals, 4.0) == ConditionCode.OTHER_POSE_PUBLISHER


def test_it_is_forgotten_when_it_stays_away():
    rivals, _ = played((30, 1, 0.0), (30, 1, 1.0), until_s=2.0)
    for k in range(150):
        rivals.take_pose2d(1000 + k, 2.0 + k / 30)
    assert code(rivals, 7.0) is None


def test_publishers_of_other_names_are_found_before_they_publish():
    rivals = Rivals("/drocap")
    rivals.set_names(["/drocap/pose_estimator", "/drocap/pose_estimator"])  # a killed one and its successor
    assert rivals.condition(0.0) is None
    rivals.set_names(["/drocap/pose_estimator", "/drocap/session_player"])
    assert "(/drocap/pose_estimator, /drocap/session_player)" in str(rivals.condition(0.0))


def test_a_strange_status_is_a_second_bridge_until_it_is_silent():
    rivals = Rivals("/drone1")
    for stamp in range(10):
        rivals.published_status(stamp)
        rivals.take_status(stamp, 0.2 * stamp)
        assert rivals.condition(0.2 * stamp) is None
    rivals.take_status(77, 2.0)
    assert code(rivals, 4.9) == ConditionCode.SECOND_BRIDGE
    assert "/drone1" in str(rivals.condition(2.0))
    assert rivals.condition(5.1) is None


def test_numbers_that_are_unknown_are_no_rival():
    rivals = Rivals("/drocap")
    for number, at in zip(itertools.repeat(0, 50), itertools.count(0.0, 0.03), strict=False):
        rivals.take_pose2d(number, at)
    assert rivals.condition(1.0) is None
