"""The scale of the ranges from the vehicle's own way about a subject who stands."""

import numpy as np
import pytest

from drocap_ros.flight.subject.guard import Parallax

_STEP_S, _RADIUS_M = 0.1, 6.0


def flown(range_error, seconds=60.0, wander_m=0.0, size_error=0.04, turn_deg_s=11.0, seed=0, speed_m_s=0.0):
    """Scale after an orbit in which all ranges are wrong by a share, and the own place wanders for seconds."""
    rng, wander = np.random.default_rng(seed), np.zeros(2)
    found = Parallax(size_error)
    fade = np.exp(-_STEP_S / 3.0)
    for t in np.arange(0.0, seconds, _STEP_S):
        angle = np.deg2rad(turn_deg_s) * t
        sight = -_RADIUS_M * np.array([np.cos(angle), np.sin(angle)])
        wander = fade * wander + np.sqrt(1 - fade**2) * wander_m * rng.standard_normal(2)
        measured = (1 + range_error) * (1 + 0.03 * rng.standard_normal()) * sight
        found.take(np.array([3.0, -8.0]) - sight + wander, measured, _STEP_S, speed_m_s)
    return found


@pytest.mark.parametrize("error", [-0.06, 0.0, 0.05])
def test_an_orbit_shows_by_how_much_the_ranges_err(error):
    assert flown(error).scale * (1 + error) == pytest.approx(1.0, abs=0.01)


def test_a_place_that_wanders_as_recorded_leaves_most_of_the_correction():
    left = [abs(flown(-0.06, wander_m=0.26, seed=seed).scale * 0.94 - 1.0) for seed in range(8)]
    assert np.mean(left) < 0.03


def test_a_vehicle_that_hovers_believes_the_size_of_the_body():
    for wander_m in (0.0, 0.26):
        hovering = flown(-0.06, wander_m=wander_m, turn_deg_s=0.0)
        assert hovering.scale == pytest.approx(1.0, abs=0.01)


def test_the_correction_is_bounded_and_survives_a_walk():
    found = flown(-0.3)
    assert found.scale == pytest.approx(1.08, abs=0.005)
    for step in range(100):
        found.take(np.array([0.14 * step, 0.0]), np.array([6.0, 0.0]), _STEP_S, 1.4)
    assert found.scale == pytest.approx(1.08, abs=0.005)


def test_the_speed_by_which_one_who_stands_seems_to_move_takes_nothing_from_the_correction():
    assert flown(-0.06, speed_m_s=0.5).scale * 0.94 == pytest.approx(1.0, abs=0.01)
