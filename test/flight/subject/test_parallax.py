"""Scale of the ranges and error of the heading from the vehicle's own way about a subject who stands."""

import math

import numpy as np
import pytest

from drocap_ros.flight.subject.guard import Parallax

_STEP_S, _RADIUS_M = 0.1, 6.0


def flown(range_error, seconds=60.0, wander_m=0.0, turn_deg_s=11.0, seed=0, speed_m_s=0.0, erring=(0.0, 20.0, 0.0)):
    """An orbit in which all ranges are wrong by a share, and own place and heading wander; deg that are left of it.

    erring : standard deviation of the heading in deg, how long its error lasts, error of the gyroscope in deg/s
    """
    heading_deg, lasts_s, gyro_deg_s = erring
    rng, wander, heading = np.random.default_rng(seed), np.zeros(2), 0.0
    found, left = Parallax(0.04, math.radians(max(heading_deg, 0.6))), []
    fade, stays = np.exp(-_STEP_S / 3.0), np.exp(-_STEP_S / lasts_s)
    for t in np.arange(0.0, seconds, _STEP_S):
        angle = np.deg2rad(turn_deg_s) * t
        sight = -_RADIUS_M * np.array([np.cos(angle), np.sin(angle)])
        wander = fade * wander + np.sqrt(1 - fade**2) * wander_m * rng.standard_normal(2)
        step = (stays - 1.0) * heading + np.sqrt(1 - stays**2) * np.deg2rad(heading_deg) * rng.standard_normal()
        heading += step
        seen = (1 + range_error) * (1 + 0.03 * rng.standard_normal()) * sight
        c, s = np.cos(heading), np.sin(heading)
        found.turn(_STEP_S, step + np.deg2rad(gyro_deg_s) * _STEP_S)
        found.take(np.array([3.0, -8.0]) - sight + wander, np.array([[c, -s], [s, c]]) @ seen, _STEP_S, speed_m_s)
        left.append(found.heading - heading)
    return found, np.rad2deg(left)


@pytest.mark.parametrize("error", [-0.06, 0.0, 0.05])
def test_an_orbit_shows_by_how_much_the_ranges_err(error):
    assert flown(error)[0].scale * (1 + error) == pytest.approx(1.0, abs=0.01)


def test_a_place_that_wanders_as_recorded_leaves_most_of_the_correction():
    left = [abs(flown(-0.06, wander_m=0.26, seed=seed)[0].scale * 0.94 - 1.0) for seed in range(8)]
    assert np.mean(left) < 0.03


def test_a_vehicle_that_hovers_believes_the_size_of_the_body():
    for wander_m in (0.0, 0.26):
        hovering, _ = flown(-0.06, wander_m=wander_m, turn_deg_s=0.0)
        assert hovering.scale == pytest.approx(1.0, abs=0.01)


def test_the_correction_is_bounded_and_survives_a_walk():
    found, _ = flown(-0.3)
    assert found.scale == pytest.approx(1.08, abs=0.01)
    for step in range(100):
        found.take(np.array([0.14 * step, 0.0]), np.array([6.0, 0.0]), _STEP_S, 1.4)
    assert found.scale == pytest.approx(1.08, abs=0.01)


def test_the_speed_by_which_one_who_stands_seems_to_move_takes_nothing_from_the_correction():
    assert flown(-0.06, speed_m_s=0.5)[0].scale * 0.94 == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "erring",
    [(6.0, 20.0, 0.0), (6.0, 20.0, 0.3), (6.0, 4.0, 0.3), (15.0, 60.0, 0.3), (6.0, 20.0, -1.5)],
)
def test_half_an_orbit_shows_the_error_of_the_heading_which_the_gyroscope_follows(erring):
    for seed in range(4):
        _, left = flown(0.02, 80.0, wander_m=0.26, seed=seed, erring=erring)
        assert np.abs(left[300:]).mean() < 2.5


def test_one_who_walks_shows_no_heading():
    found = Parallax(0.04, math.radians(6.0))
    for step in range(200):
        t = _STEP_S * step
        found.turn(_STEP_S, 0.0)
        found.take(np.zeros(2), np.array([6.0, 1.4 * t]), _STEP_S, 1.4)
    assert abs(found.heading) < math.radians(1.0)
