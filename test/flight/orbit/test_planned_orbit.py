"""An orbit by a plan: wishes are judged as an operator's, and without a usable one the orbit is the steady one."""

import math

import numpy as np
import pytest

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Command, State
from drocap_ros.flight.orbit.view_plan import EARLY_S
from drocap_ros.flight.orbit_goal import Wish
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

WISH = Wish(bearing_rad=math.radians(80.0), height_m=4.0, until_s=math.inf, why="a test")
START_S = 4.0


def flown(wish, seconds, **values):
    """A flight from 0 degrees whose plan has this wish from its start on; at 15 deg/s and 2.5 m without it."""
    settings = with_config(LoopSettings(height_m=2.5), angular_speed_deg_s=15.0, **values)
    loop = OrbitLoop(settings)
    loop.controller.on_wish(wish)
    loop.start(START_S)
    loop.run(seconds)
    assert loop.status.state == State.ORBITING
    return loop


def test_a_wish_is_flown_after_one_early_reversal():
    loop = flown(WISH, START_S + 2 * EARLY_S + 14.0, plan="accuracy")
    status = loop.status
    assert status.condition.code == ConditionCode.PLANNED
    assert status.reason.endswith("m high: a test")
    assert status.height_m == pytest.approx(4.0, abs=0.3)
    time, x, y = np.array([(row.t_s - START_S, *(row.position - loop.pelvis(row.t_s))[:2]) for row in loop.rows]).T
    bearing = np.degrees(np.unwrap(np.arctan2(y, x)))
    assert np.abs(bearing[time > 2 * EARLY_S + 8.0] - 80.0).max() < 60.0
    assert np.abs(np.diff(bearing)).max() < 0.05 * 18.0  # deg in a step of 20 Hz: as asked, and its overshoot
    senses = np.sign(np.interp([4.0, 10.0, 15.0], time[1:], np.diff(bearing)))
    np.testing.assert_array_equal(senses, [1.0, -1.0, 1.0])


@pytest.mark.parametrize(
    ("wish", "why"),
    [
        ("no pose is in map", "no pose is in map"),
        (WISH._replace(until_s=10.0), "no newer forecast of the views"),
    ],
)
def test_without_a_usable_wish_the_orbit_is_the_steady_one(wish, why):
    status = flown(wish, 18.0, plan="accuracy").status
    assert status.condition.code == ConditionCode.UNPLANNED
    assert f"steadily instead of by the plan: {why}" in status.reason
    assert status.height_m == pytest.approx(2.5, abs=0.3)
    assert status.angular_speed_deg_s == pytest.approx(15.0, abs=2.5)


@pytest.mark.parametrize("height_m", [19.9, 0.2, math.inf])
def test_a_wish_beyond_the_limits_is_not_flown(height_m):
    loop = flown(WISH._replace(height_m=height_m), START_S + 2 * EARLY_S + 3.0, plan="accuracy")
    assert loop.status.condition.code == ConditionCode.UNPLANNED
    assert "height_m: expected" in loop.status.reason
    assert loop.status.height_m == pytest.approx(2.5, abs=0.3)


def test_an_orbit_without_a_plan_has_no_ear_for_wishes():
    status = flown(WISH, 12.0).status
    assert status.condition.code == ConditionCode.ORBITING
    assert status.angular_speed_deg_s > 0.0


def test_a_plan_is_asked_for_and_given_up_by_commands():
    loop = flown(WISH, 8.0)
    codes = []
    for plan in ("accuracy", "", "steady", "fast"):
        loop.command(Command.ADJUST, plan)
        loop.run(loop.t + 0.2)
        codes.append((loop.status.condition.code, loop.answers[-1][1].condition.code))
    adjusted, unknown = ConditionCode.ADJUSTED, ConditionCode.PLAN_UNKNOWN
    planned, steady = ConditionCode.PLANNED, ConditionCode.ORBITING
    assert codes == [(planned, adjusted), (planned, adjusted), (steady, adjusted), (steady, unknown)]
