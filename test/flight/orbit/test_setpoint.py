"""No setpoint is sent that would break a limit if it stayed the last one."""

import dataclasses
import math

import numpy as np
import pytest
from orbit_observations import GOOD, changed

from drocap_ros.flight.autopilot.autopilot import LossSettings
from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.autopilot.px4 import PX4
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.observed import Observed
from drocap_ros.flight.orbit.setpoint import Shortfall, harmless
from drocap_ros.flight.orbit.speed import coast_speed, slowed_condition

LIMITS = MavlinkBridgeConfig()
ZERO, CENTRE = np.zeros(3), np.zeros(2)


def seen(position=(6.0, 0.0, 2.5), velocity=(0.0, 2.0, 0.0), subject=(0.0, 0.0, 1.0), timeout_s=0.5, by="ardupilot"):
    return changed(
        Observed(), autopilot=by, position=np.array(position), velocity=np.array(velocity), yaw=math.pi,
        subject=np.array(subject), loss_settings=LossSettings("GUID_TIMEOUT", timeout_s, "", math.nan),
    )  # fmt: skip


def sent_of(setpoint, now, subject_velocity, fence_centre, limits):
    """What is sent, or why nothing may be."""
    setpoint, problem = harmless(setpoint, changed(now, subject_velocity=subject_velocity), fence_centre, limits)
    return setpoint if problem is None else problem


def flight(now, velocity=None, acceleration=(-0.66, 0.0, 0.0)):
    wanted = now.vehicle.velocity if velocity is None else np.array(velocity)
    return Setpoint(now.vehicle.position.copy(), wanted, np.array(acceleration), math.pi, 0.3)


def test_setpoint_of_a_calm_orbit_is_sent_whole():
    now = seen(velocity=(0.0, coast_speed(seen(), LIMITS), 0.0))
    sent = sent_of(flight(now), now, ZERO, CENTRE, LIMITS)
    assert isinstance(sent, Setpoint)
    assert np.allclose(sent.velocity, now.vehicle.velocity)
    assert np.allclose(sent.acceleration, [-0.66, 0.0, 0.0])


def test_setpoint_of_a_long_coast_is_slowed_down():
    now = seen(velocity=(0.0, 2.6, 0.0))
    sent = sent_of(flight(now), now, ZERO, CENTRE, LIMITS)
    assert isinstance(sent, Setpoint)
    assert np.linalg.norm(sent.velocity) < 2.4


def test_px4_falls_behind_along_the_orbit_before_it_yields_the_radius():
    """A walker ahead of it was chased from far behind: after kills it moved by 3.7 m."""
    now = seen(velocity=(-0.9, 0.9, 0.0), by="px4")
    wanted = flight(now, acceleration=ZERO)._replace(position=now.vehicle.position + np.array([-0.3, 1.4, 0.0]))
    sent = sent_of(wanted, now, np.array([-0.9, 0.0, 0.0]), CENTRE, LIMITS)
    assert isinstance(sent, Setpoint)
    assert (sent.position - now.vehicle.position)[0] == pytest.approx(-0.3)
    assert sent.velocity[0] == pytest.approx(-0.9)
    assert (sent.position - now.vehicle.position)[1] < 1.2
    coast = PX4.coast_of(sent, now.vehicle.position, now.vehicle.velocity, 0.5)
    assert coast.length_m <= 0.82 * LIMITS.max_coast_m


def test_px4_is_not_pulled_to_a_far_place_faster_than_it_may_fly():
    now = seen(velocity=(0.0, 0.9, 0.0), by="px4")
    pulled = []
    for way, walking in ((1.4, 0.0), (1.4, 1.4), (0.2, 0.0)):
        wanted = flight(now, acceleration=ZERO)._replace(position=now.vehicle.position + np.array([0.0, way, 0.0]))
        sent = sent_of(wanted, now, np.array([0.0, walking, 0.0]), CENTRE, LIMITS)
        assert isinstance(sent, Setpoint)
        commanded = sent.velocity[1] + PX4.position_gain_per_s * (sent.position - now.vehicle.position)[1]
        pulled.append(commanded)
        assert sent.velocity[1] == pytest.approx(0.9)
    assert sent.position[1] == pytest.approx(now.vehicle.position[1] + 0.2)
    standing, walker, near = pulled
    assert near < standing < walker < 0.9 + PX4.position_gain_per_s * 1.4
    assert standing < 1.5 * coast_speed(now, LIMITS)


def test_px4_creeps_on_after_its_stop_so_it_comes_nearer_more_slowly():
    now = seen(position=(8.0, 0.0, 2.5), velocity=(-0.3, 0.0, 0.0), by="px4")
    wanted = flight(now, velocity=(-0.6, 0.0, 0.0), acceleration=ZERO)
    sent = sent_of(wanted, now, ZERO, CENTRE, LIMITS)
    assert isinstance(sent, Setpoint)
    coast = PX4.coast_of(sent, now.vehicle.position, now.vehicle.velocity, 0.5)
    assert coast.creep_towards(0j) > 0.4
    assert float(coast.place[0].real - coast.place[-1].real) + coast.creep_towards(0j) <= 0.9
    assert -0.5 < sent.velocity[0] < 0.0
    follows = sent_of(wanted, now, np.array([-0.6, 0.0, 0.0]), CENTRE, LIMITS)
    assert isinstance(follows, Setpoint)
    assert follows.velocity[0] == pytest.approx(-0.6), "he recedes as fast"


def test_px4_that_lacks_more_of_its_distance_retreats_no_more_slowly():
    """Steps of the share left nothing of a way of 1.5 m, but half of one of 1 m: walkers caught up."""
    now = seen(position=(4.6, 0.0, 2.5), velocity=(1.1, 0.0, 0.0), by="px4")
    comes, ways = np.array([1.4, 0.0, 0.0]), []
    for way in (0.6, 1.0, 1.5):
        wanted = flight(now, comes, (0.5, 0.0, 0.0))._replace(position=now.vehicle.position + np.array([way, 0.0, 0.0]))
        sent = sent_of(wanted, now, comes, CENTRE, LIMITS)
        assert isinstance(sent, Setpoint)
        coast = PX4.coast_of(sent, now.vehicle.position, now.vehicle.velocity, 0.5)
        assert coast.length_m <= 0.82 * LIMITS.max_coast_m
        ways.append((sent.position - now.vehicle.position)[0])
    assert min(ways) > 0.5
    assert np.all(np.diff(ways) > -0.05)


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_no_setpoint_leads_past_the_minimum_distance(speed):
    now = seen(position=(3.4, 0.0, 2.5), velocity=(-speed, 0.0, 0.0))
    sent = sent_of(flight(now, acceleration=(0.0, 0.0, 0.0)), now, ZERO, CENTRE, LIMITS)
    assert isinstance(sent, Condition)
    assert sent.code == ConditionCode.COAST_UNSAFE
    assert "come to" in str(sent)


def test_a_subject_that_comes_counts_as_it_moves():
    now = seen(position=(4.6, 0.0, 2.5), velocity=(-0.6, 0.0, 0.0))
    wanted = flight(now, acceleration=(0.0, 0.0, 0.0))
    stands = sent_of(wanted, now, ZERO, CENTRE, LIMITS)
    comes = sent_of(wanted, now, np.array([1.2, 0.0, 0.0]), CENTRE, LIMITS)
    assert isinstance(stands, Setpoint)
    assert isinstance(comes, Setpoint)
    assert abs(comes.velocity[0]) < 0.95 * abs(stands.velocity[0])


def test_a_vehicle_that_leaves_a_near_subject_may_go_on():
    now = seen(position=(3.1, 0.0, 2.5), velocity=(1.0, 0.0, 0.0))
    assert isinstance(sent_of(flight(now), now, np.array([1.0, 0.0, 0.0]), CENTRE, LIMITS), Setpoint)


def test_the_coast_stays_inside_the_fence():
    limits = dataclasses.replace(LIMITS, fence_radius_m=10.0)
    now = seen(position=(8.5, 0.0, 2.5), velocity=(2.0, 0.0, 0.0), subject=(3.0, 0.0, 1.0))
    assert isinstance(sent_of(flight(now), now, ZERO, None, limits), Setpoint)
    slowed = sent_of(flight(now), now, ZERO, CENTRE, limits)
    assert isinstance(slowed, Setpoint)
    assert slowed.velocity[0] < 0.9
    late = changed(now, position=np.array([9.3, 0.0, 2.5]))
    sent = sent_of(flight(late), late, ZERO, CENTRE, limits)
    assert isinstance(sent, Condition)
    assert sent.code == ConditionCode.AT_FENCE
    assert "from where the orbit began" in str(sent)
    slow = changed(now, velocity=np.array([0.8, 0.0, 0.0]))
    sent = sent_of(flight(slow), slow, ZERO, CENTRE, limits)
    assert isinstance(sent, Setpoint)


def test_speed_that_the_coast_allows_follows_the_autopilots_timeout():
    assert coast_speed(seen(timeout_s=0.3), LIMITS) > coast_speed(seen(), LIMITS) > 1.7
    unknown = seen(timeout_s=math.nan)
    assert coast_speed(unknown, LIMITS) == coast_speed(seen(timeout_s=3.0), LIMITS)


def test_status_names_the_angular_speed_that_the_coast_allows():
    flown = condition(ConditionCode.ORBITING)
    usual, wide = (OrbitGoal(radius, 2.5, math.radians(19)) for radius in (6.0, 10.0))
    assert slowed_condition(flown, usual, seen(timeout_s=0.3), LIMITS) == flown
    slowed = slowed_condition(flown, wide, seen(), LIMITS)
    assert slowed.code == ConditionCode.SLOWED
    assert "orbiting the subject, at 1" in str(slowed)
    assert "instead of 19.0" in str(slowed)
    degraded = condition(ConditionCode.DEGRADED, cause=condition(ConditionCode.NO_SUBJECT))
    assert slowed_condition(degraded, wide, seen(), LIMITS) == degraded


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
