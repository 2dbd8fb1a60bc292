"""The acceleration that PX4 lacks behind a walking subject."""

import numpy as np
import pytest
from orbit_observations import GOOD, changed

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.orbit.setpoint import Shortfall

HERE, SUBJECT = np.array([6.0, 0.0, 2.5]), np.zeros(3)
ASKED = Setpoint(HERE, np.array([-1.4, 0.5, 0.0]), np.zeros(3), np.pi, 0.0)


def added(autopilot="px4", flown=(-0.8, -0.5, 0.0), walking=(-1.4, 0.0, 0.0), seconds=10.0, asked=ASKED):
    shortfall = Shortfall()
    seen = changed(GOOD, autopilot=autopilot, position=HERE, velocity=np.array(flown), subject=SUBJECT)
    for _ in range(int(seconds * 20)):
        shortfall.learn(asked, seen, 0.05)
    return shortfall.added(asked, seen, np.array(walking)[:2]).acceleration


def test_px4_gets_what_it_lacks_along_the_sight_and_no_more_than_the_bound():
    slow, fast = (-0.8, 0.5, 0.0), (-2.0, 0.5, 0.0)
    assert added(flown=slow) == pytest.approx([-0.6, 0.0, 0.0])
    assert added(flown=fast) == pytest.approx([0.6, 0.0, 0.0])
    assert added(flown=(-1.4, -0.5, 0.0)) == pytest.approx(np.zeros(3))  # across the sight
    assert -0.2 < added(flown=slow, seconds=0.3)[0] < 0.0  # an integral, no damping


def test_nothing_is_added_for_a_standing_subject_or_a_vehicle_that_follows_or_integrates():
    assert not added(walking=(0.2, 0.1, 0.0)).any()
    assert not added(flown=tuple(ASKED.velocity)).any()
    assert not added(autopilot="ardupilot").any()
