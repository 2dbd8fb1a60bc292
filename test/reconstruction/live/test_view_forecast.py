"""Forecast of the views of a person, by poses whose best view is known."""

import numpy as np
import pytest

from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.live.view_forecast import ViewForecaster
from drocap_ros.simulation.simulated_person import simulate_person

T = np.arange(0.0, 4.0, 1 / 15)
STAMPS = np.round(1e9 * T).astype(np.int64)


def body(action="stand"):
    """(F, 17, 3) m with toes, of one who faces north and keeps facing there."""
    joints = simulate_person(T, action, 1)
    toes = joints[:, [3, 6]] + np.array([0.0, 0.15, -0.05])
    joints = np.concatenate([joints, toes], axis=1)
    across = (joints[:, 1] - joints[:, 4])[:, :2]
    facing = np.degrees(np.arctan2(across[:, 1], across[:, 0]))
    return np.stack([turned(pose - pose[0], -angle) for pose, angle in zip(joints, facing, strict=True)])


def turned(joints, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return joints @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def forecaster():
    return ViewForecaster(Lifter.load())


def at(found, bearing, elevation=10.0):
    away = np.abs(np.mod(found.bearing_deg - bearing + 180.0, 360.0) - 180.0) + np.abs(found.elevation_deg - elevation)
    assert away.min() < 5.0
    return found.error_m[away.argmin()]


def test_a_leg_that_is_raised_towards_a_camera_is_seen_better_from_the_side(forecaster):
    joints = body()
    raised = np.array([[0.0, 0.45, -0.1], [0.0, 0.88, -0.15], [0.0, 0.93, 0.0]])
    joints[:, [2, 3, 15]] = joints[:, [1, 1, 1]] + raised
    found = forecaster.forecast(STAMPS, joints)
    assert max(at(found, 0.0), at(found, 180.0)) < 0.5 * at(found, 90.0)


def test_the_forecast_turns_with_the_person(forecaster):
    joints = body("squats")
    found = forecaster.forecast(STAMPS, joints)
    forecaster.reset()
    quarter = forecaster.forecast(STAMPS, turned(joints, 90.0))
    np.testing.assert_allclose(quarter.error_m, found.error_m, rtol=0.02)
    np.testing.assert_allclose(np.mod(quarter.bearing_deg - found.bearing_deg, 360.0), 90.0, atol=0.1)


def test_later_windows_change_the_average_little_by_little(forecaster):
    squats, boxing = body("squats"), body("boxing")
    first = forecaster.forecast(STAMPS, squats).error_m
    soon = forecaster.forecast(STAMPS + 10**9, boxing).error_m
    for later_s in range(2, 40, 3):
        late = forecaster.forecast(STAMPS + later_s * 10**9, boxing).error_m
    forecaster.reset()
    alone = forecaster.forecast(STAMPS, boxing).error_m
    np.testing.assert_allclose(np.log(soon / first), 0.095 * np.log(alone / first), atol=0.001)
    np.testing.assert_allclose(late, alone, rtol=0.05)


def test_the_turn_of_the_person_is_measured(forecaster):
    joints = np.stack([turned(pose, 30.0 * t) for pose, t in zip(body(), T, strict=True)])
    assert forecaster.forecast(STAMPS, joints).turn_deg_s == pytest.approx(30.0, abs=1.0)


def test_poses_of_too_short_a_time_give_no_forecast(forecaster):
    joints = body()
    assert forecaster.forecast(STAMPS[:10], joints[:10]) is None
    joints[4:-3] = np.nan
    assert forecaster.forecast(STAMPS, joints) is None
