"""The room to stop in before the subject: own speed and chase count together."""

import numpy as np
import pytest
from orbit_observations import GOOD, LIMITS, changed, orbiting

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.orbit.motion_checks import stopping_room, subject_condition
from drocap_ros.flight.orbit.safety import reduce
from drocap_ros.flight.orbit.states import State

SAFETY = LIMITS.safety
BRAKING = SAFETY.braking_m_s2


def seen(distance_m=6.0, **values):
    place = np.array([distance_m, 0.0, 2.5])
    return changed(GOOD, position=place, subject_distance_m=distance_m, subject_sd_m=0.0, **values)


def braking(speed):
    return speed**2 / (2 * BRAKING)


def test_own_speed_and_chase_count_together():
    # The estimate recedes at 1 m/s and the vehicle closes at 2.5: the person may stand.
    room = stopping_room(seen(closing_m_s=2.5, approach_m_s=-1.0), SAFETY)
    assert room > braking(2.5) > braking(1.5) + braking(1.0)
    assert room == pytest.approx(braking(2.5), abs=0.3)
    # A vehicle that has fallen behind will follow at the speed of the chase.
    assert stopping_room(seen(closing_m_s=0.0, approach_m_s=-1.4), SAFETY) > braking(1.4)
    # A person who comes nearer walks on until the vehicle stands.
    both = stopping_room(seen(closing_m_s=1.0, approach_m_s=1.0), SAFETY)
    assert both > braking(1.0) + 1.0 * (0.5 + 1.0 / BRAKING)
    assert stopping_room(seen(closing_m_s=-2.0), SAFETY) < 0.1


def test_vehicle_that_flies_away_as_fast_as_the_person_comes_needs_no_room_for_his_steps():
    # The vehicle followed him, and he turned: a hold would end the flight away from him.
    away = stopping_room(seen(closing_m_s=-1.3, approach_m_s=1.3), SAFETY)
    assert away < 0.2
    gains = stopping_room(seen(closing_m_s=-0.5, approach_m_s=1.3), SAFETY)
    assert gains >= away + 0.8 * 0.5
    assert stopping_room(seen(closing_m_s=0.0, approach_m_s=1.3), SAFETY) >= 1.3 * 0.5


def test_uncertainty_of_position_and_speeds_is_added():
    calm = changed(seen(closing_m_s=1.0), subject_sd_m=0.4)
    assert stopping_room(calm, SAFETY) >= braking(1.0) + 0.4
    # Faster by a standard deviation than estimated, until the vehicle reacts.
    unsure = changed(calm, approach_sd_m_s=0.6)
    assert stopping_room(unsure, SAFETY) - stopping_room(calm, SAFETY) == pytest.approx(0.5 - 0.4)


def test_orbit_ends_before_the_vehicle_cannot_stop_any_more():
    # 2.4 m of room are needed at 2.5 m/s; two separate distances would have been 1.3 m.
    near = seen(5.0, closing_m_s=2.5, approach_m_s=-1.0)
    assert subject_condition(near, LIMITS).code == ConditionCode.SUBJECT_NEAR
    assert reduce(orbiting(), near, 1.0, None, LIMITS)[0].state == State.HOLDING
    assert subject_condition(seen(5.8, closing_m_s=2.5, approach_m_s=-1.0), LIMITS) is None
