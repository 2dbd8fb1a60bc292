"""PX4 that stands: recorded hovers moved within 3 s by 0.40 m in the mean of 18, and by 0.12 to 0.67 m."""

import numpy as np
import pytest

from drocap_ros.simulation.vehicle.dynamics import AIRFRAMES, Body
from drocap_ros.simulation.vehicle.estimate_error import EstimateError


def greatest_move_m(seed):
    """Greatest change of the estimate's error within 3 s, of 5.5 s."""
    error, places = EstimateError(0.4, True, seed), []
    for _ in range(550):
        error.step(False, 0.01)
        places.append(error.position[:2].copy())
    path = np.array(places)
    return float(np.linalg.norm(path[300:] - path[:-300], axis=1).max())


def test_the_estimate_wanders_as_recorded():
    moves = [greatest_move_m(seed) for seed in range(40)]
    assert np.mean(moves) == pytest.approx(0.40, abs=0.06)
    assert np.quantile(moves, 0.9) < 0.67


def test_own_motion_in_wind_is_slowed_down_by_the_recorded_friction():
    body = Body(np.zeros(3), 0.0, np.array([8.0, 0.0, 0.0]), AIRFRAMES["px4"])
    rest = body.drag()
    body.velocity = np.array([-1.4, 0.0, 0.0])
    assert body.drag() - rest == pytest.approx(np.array([1.4, 0.0, 0.0]))
    assert rest[0] == pytest.approx(0.016 * 64.0)
