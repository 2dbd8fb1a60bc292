"""An orbit by a plan: wishes are judged as an operator's, and without a usable one the orbit is the steady one."""

import math

import pytest

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.states import Command, State
from drocap_ros.flight.orbit_goal import Wish
from lab.flights.orbit_loop import LoopSettings, OrbitLoop, with_config

WISH = Wish(height_m=4.0, angular_speed_deg_s=-12.0, until_s=math.inf, why="a test")


def flown(wish, seconds, **values):
    """A flight whose plan has this wish from its start on; at 15 deg/s and 2.5 m without it."""
    settings = with_config(LoopSettings(height_m=2.5), angular_speed_deg_s=15.0, **values)
    loop = OrbitLoop(settings)
    loop.controller.on_wish(wish)
    loop.start()
    loop.run(seconds)
    assert loop.status.state == State.ORBITING
    return loop


def test_a_wish_within_the_limits_is_flown():
    loop = flown(WISH, 20.0, plan="accuracy")
    status = loop.status
    assert status.condition.code == ConditionCode.PLANNED
    assert status.reason.endswith("by the plan at -12 deg/s and 4.0 m high: a test")
    assert status.height_m == pytest.approx(4.0, abs=0.3)
    assert status.angular_speed_deg_s == pytest.approx(-12.0, abs=2.5)


@pytest.mark.parametrize(
    ("wish", "why"),
    [
        ("no pose is in map", "no pose is in map"),
        (WISH._replace(until_s=10.0), "no newer adjusted poses"),
        (WISH._replace(height_m=19.9), "height_m: expected 1.5 to 19.5 m"),
        (WISH._replace(height_m=0.2), "height_m: expected 1.5 to 19.5 m"),
        (WISH._replace(height_m=math.inf), "height_m: expected a finite number"),
    ],
)
def test_without_a_usable_wish_the_orbit_is_the_steady_one(wish, why):
    status = flown(wish, 12.0, plan="accuracy").status
    assert status.condition.code == ConditionCode.UNPLANNED
    assert f"steadily instead of by the plan: {why}" in status.reason
    assert status.height_m == pytest.approx(2.5, abs=0.3)
    assert status.angular_speed_deg_s == pytest.approx(15.0, abs=2.5)


def test_a_wish_is_never_faster_than_what_was_asked():
    status = flown(WISH._replace(angular_speed_deg_s=-60.0), 6.0, plan="accuracy").status
    assert "by the plan at -15 deg/s" in status.reason


def test_an_orbit_without_a_plan_has_no_ear_for_wishes():
    status = flown(WISH, 12.0).status
    assert status.condition.code == ConditionCode.ORBITING
    assert status.angular_speed_deg_s > 0.0


def test_a_plan_is_asked_for_and_given_up_by_commands():
    loop = flown(WISH, 8.0)
    codes = []
    for plan in ("accuracy", "", "steady", "fast"):
        loop.command(Command.ADJUST, plan=plan)
        loop.run(loop.t + 0.2)
        codes.append((loop.status.condition.code, loop.answers[-1][1].condition.code))
    adjusted, unknown = ConditionCode.ADJUSTED, ConditionCode.PLAN_UNKNOWN
    planned, steady = ConditionCode.PLANNED, ConditionCode.ORBITING
    assert codes == [(planned, adjusted), (planned, adjusted), (steady, adjusted), (steady, unknown)]
