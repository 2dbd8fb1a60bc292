"""The place that a plan chooses, and the way there."""

import math
import subprocess
import sys

import numpy as np
import pytest

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.planner import Ramp, begin_orbit
from drocap_ros.flight.orbit.view_plan import EARLY_S, Reach, ViewForecast, choose_view, fly_plan, planned_goal
from drocap_ros.flight.orbit_goal import Wish, goal_of

REACH = Reach(6.0, 17.0, 1.0, (1.5, 4.0))
BEARING, ELEVATION = (grid.ravel() for grid in np.meshgrid(np.arange(0.0, 360.0, 45.0), [8.0, 22.0, 38.0]))


def views(best_deg, least_m=0.02, turn_deg_s=0.0):
    """A person who is seen best from one side, three times worse from the other, and better from below."""
    away = 0.5 - 0.5 * np.cos(np.radians(BEARING - best_deg))
    return ViewForecast(BEARING, ELEVATION, least_m * 3.0**away * (1.0 + ELEVATION / 100.0), turn_deg_s)


def chosen(forecast, place=(0.0, 2.5), former=None):
    return choose_view(forecast, place, REACH, former, 100.0)


@pytest.mark.parametrize("best_deg", [90.0, 225.0, 300.0])
def test_the_best_side_and_the_better_height_are_chosen(best_deg):
    wish = chosen(views(best_deg))
    assert math.degrees(wish.bearing_rad) == pytest.approx(best_deg, abs=31.0)
    assert wish.height_m == pytest.approx(1.79, abs=0.01)
    assert 100.0 < wish.until_s < 110.0


def test_the_order_of_the_views_does_not_matter():
    forecast, order = views(90.0), np.random.default_rng(1).permutation(len(BEARING))
    mixed = ViewForecast(*(values[order] for values in forecast[:3]), 0.0)
    assert chosen(mixed) == chosen(forecast)


def test_heights_are_those_of_the_limits():
    high = views(90.0)._replace(error_m=views(90.0).error_m / (1.0 + ELEVATION / 100.0) ** 3)
    assert chosen(high).height_m == 4.0


def test_a_place_that_is_hardly_better_does_not_change_the_wish():
    former = chosen(views(90.0))
    assert chosen(views(110.0), former=former)[:2] == former[:2]
    assert chosen(views(200.0), former=former)[:2] != former[:2]


def test_the_plan_goes_where_the_person_turns_to():
    still, turning = chosen(views(90.0)), chosen(views(90.0, turn_deg_s=20.0))
    ahead = math.degrees(math.remainder(turning.bearing_rad - still.bearing_rad, 2 * math.pi))
    assert 10.0 <= ahead <= 45.0


@pytest.mark.parametrize("wanted", [19.0, -12.0])
def test_the_goal_of_a_wish_is_never_faster_and_turns_once_early(wanted):
    goal = goal_of(MavlinkBridgeConfig(), angular_speed_deg_s=wanted)
    start = begin_orbit(np.array([6.0, 0.0, 2.5]), np.zeros(3), MavlinkBridgeConfig())
    chance, flown_s = np.random.default_rng(1), np.arange(0.0, 60.0, 0.1)
    speeds = []
    for t in flown_s:
        wish = Wish(chance.uniform(-9, 9), chance.uniform(-50, 50), math.inf, "")
        state = start._replace(phase=chance.uniform(-9, 9), omega=Ramp(chance.uniform(-0.3, 0.3)), flown_s=t)
        planned = planned_goal(goal, wish, state)
        assert planned.radius_m == goal.radius_m
        speeds.append(planned.angular_speed_rad_s)
    np.testing.assert_allclose(np.abs(speeds), abs(goal.angular_speed_rad_s))
    early = np.sign(speeds)[flown_s < 2 * EARLY_S - 1e-9] * np.sign(wanted)
    assert set(early[: len(early) // 2]) == {1.0}
    assert set(early[len(early) // 2 :]) == {-1.0}


def test_a_planned_flight_arrives_and_swings_about_its_place():
    config, step_s = MavlinkBridgeConfig(), 0.1
    subject, wish = np.zeros((600, 3)), Wish(math.radians(-120.0), 4.0, math.inf, "")
    places, bearings = fly_plan(
        config, goal_of(config), subject, step_s, 1.76, lambda *_: wish, np.array([6.0, 0.0, 2.5])
    )
    there = np.degrees(bearings[300:]) + 120.0
    assert there.min() == pytest.approx(-50.0, abs=8.0)
    assert there.max() == pytest.approx(50.0, abs=8.0)
    assert places[-1, 2] == pytest.approx(4.0, abs=0.05)
    np.testing.assert_allclose(np.hypot(*places[:, :2].T), 6.0, atol=0.1)
    assert np.abs(np.diff(bearings)).max() < 1.01 * 1.76 / 6.0 * step_s


def test_a_choice_in_flight_imports_no_solver():
    """The first one would stop the control loop for as long as that takes."""
    code = (
        "import sys, numpy as np; from drocap_ros.flight.orbit.view_plan import *; "
        "import drocap_ros.flight.orbit.controller; "
        "grid = [v.ravel() for v in np.meshgrid(np.arange(0.0, 360.0, 45.0), [10.0, 35.0])]; "
        "views = ViewForecast(*grid, np.linspace(0.02, 0.05, 16), 0.0); before = set(sys.modules); "
        "choose_view(views, (0.0, 2.5), Reach(6.0, 15.0, 1.0, (1.3, 19.5)), None, 0.0); "
        "print(sorted(set(sys.modules) - before))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
