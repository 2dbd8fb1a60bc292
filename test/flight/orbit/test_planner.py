import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import OrbitConfig, goal_of
from drocap_ros.flight.orbit.planner import Scene, advance, begin_orbit, least_radius, reference_position, setpoint_of

DT = 0.05


def fly(seconds, subject=lambda t: np.zeros(3), config=None, start=(9.0, 0.0, 4.0), goal=None):
    """Reference and setpoints of a vehicle that is always where it should be."""
    config = config or OrbitConfig()
    goal = goal or goal_of(config)
    vehicle = np.array(start)
    state = begin_orbit(vehicle, subject(0.0), config)
    rows = []
    for i in range(int(seconds / DT)):
        t = i * DT
        speed = (subject(t + 1e-3) - subject(t)) / 1e-3
        state = advance(state, goal, Scene(vehicle, subject(t), speed), DT, config)
        setpoint = setpoint_of(state, Scene(vehicle, subject(t), speed), config)
        vehicle = setpoint.position
        rows.append((t, state, setpoint))
    return rows


def test_reaches_radius_height_and_angular_speed():
    rows = fly(20)
    _, state, setpoint = rows[-1]
    assert state.radius.value == pytest.approx(6.0, abs=0.02)
    assert state.height.value == pytest.approx(2.5, abs=0.02)
    assert math.degrees(state.omega.value) == pytest.approx(19.0, abs=0.1)
    assert np.linalg.norm(setpoint.velocity) == pytest.approx(6 * math.radians(19), rel=0.01)
    outward = setpoint.position[:2] / np.linalg.norm(setpoint.position[:2])
    assert setpoint.acceleration[:2] @ outward == pytest.approx(-(math.radians(19) ** 2) * 6, rel=0.02)
    assert setpoint.yaw_rate == pytest.approx(math.radians(19), rel=0.02)


def test_orbit_begins_at_the_vehicle():
    _, _, first = fly(1, start=(0.0, 8.0, 5.0))[0]
    assert np.allclose(first.position, [0, 8, 5], atol=0.02)
    assert np.linalg.norm(first.velocity) < 0.2
    assert first.yaw == pytest.approx(-math.pi / 2, abs=0.01)


def test_angular_speed_ramps_in_about_three_seconds_without_overshoot():
    omega = np.array([state.omega.value for _, state, _ in fly(10)])
    top = math.radians(19)
    assert omega.max() <= top * 1.01
    assert 2.0 < np.argmax(omega > 0.95 * top) * DT < 4.0


def test_velocity_and_acceleration_are_derivatives_of_the_path():
    rows = fly(15, lambda t: np.array([1.4 * t, 0.3 * math.sin(t), 0.0]))
    position = np.array([reference_position(state) for _, state, _ in rows])
    velocity = np.array([setpoint.velocity for _, _, setpoint in rows])
    moved = np.gradient(position, DT, axis=0)
    assert np.abs(moved - velocity)[5:-5].max() < 0.15


def test_follows_a_walking_subject():
    _, state, setpoint = fly(20, lambda t: np.array([1.4 * t, 0.0, 0.0]))[-1]
    subject = np.array([1.4 * (20 - DT), 0.0])
    assert np.linalg.norm(state.centre - subject) < 0.1
    assert np.linalg.norm(setpoint.position[:2] - subject) == pytest.approx(6.0, abs=0.15)


def test_least_radius_grows_for_an_uncertain_or_walking_subject():
    config = OrbitConfig(radius_m=3.8)
    sure = least_radius(config, 0.1, 0.0, 1.3)
    assert config.min_distance_m + 0.4 < sure < 3.8
    assert least_radius(config, 0.4, 0.0, 1.3) == pytest.approx(sure + 0.6)
    assert least_radius(config, 0.1, 1.5, 1.3) > sure + 0.5
    state, vehicle = None, np.array([6.0, 0.0, 2.5])
    state = begin_orbit(vehicle, np.zeros(3), config)
    for _ in range(400):
        state = advance(
            state, goal_of(config), Scene(vehicle, np.zeros(3), np.zeros(3), least_radius_m=4.5), DT, config
        )
        vehicle = reference_position(state)
    assert state.radius.value == pytest.approx(4.5, abs=0.02)


def test_acceleration_is_what_the_orbit_needs_though_the_subject_is_estimated_with_noise():
    """The autopilot integrates the last acceleration after the bridge's death: 1.57 m/s^2 of 0.66 were noise."""
    rng = np.random.default_rng(1)
    config = OrbitConfig()
    vehicle = np.array([6.0, 0.0, 2.5])
    state, noise, sizes = begin_orbit(vehicle, np.zeros(3), config), np.zeros(2), []
    for i in range(800):
        noise = noise + (-noise * 2.0 * DT + 0.25 * np.sqrt(DT) * rng.standard_normal(2))
        subject, speed = np.append(0.5 * noise, 0.0), np.append(noise, 0.0)
        state = advance(state, goal_of(config), Scene(vehicle, subject, speed), DT, config)
        sent = setpoint_of(state, Scene(vehicle, subject, speed), config)
        vehicle = sent.position
        if i > 200:
            sizes.append(np.linalg.norm(sent.acceleration))
    needed = math.radians(19) ** 2 * 6
    assert np.mean(sizes) < 1.3 * needed
    assert max(sizes) < needed + 0.55


def test_angular_speed_yields_where_the_subject_walks_in_its_direction():
    config = OrbitConfig()
    vehicle, walk = np.array([6.0, 0.0, 2.5]), np.array([0.0, 1.4, 0.0])
    state = begin_orbit(vehicle, np.zeros(3), config)
    speeds, rates = [], []
    for i in range(1200):
        place = walk * i * DT
        state = advance(state, goal_of(config), Scene(vehicle, place, walk, greatest_speed_m_s=2.3), DT, config)
        vehicle = reference_position(state)
        speeds.append(np.linalg.norm(setpoint_of(state, Scene(vehicle, place, walk), config).velocity))
        rates.append(math.degrees(state.omega.value))
    assert max(speeds[200:]) < 2.4
    assert max(rates) > 18.5
    assert min(rates[200:]) > 7


def test_jump_of_the_subject_is_smoothed():
    rows = fly(12, lambda t: np.array([0.0 if t < 8 else 500.0, 0.0, 0.0]))
    speeds = [np.linalg.norm(setpoint.velocity) for _, _, setpoint in rows]
    steps = np.diff([setpoint.position for _, _, setpoint in rows], axis=0)
    assert max(speeds) <= OrbitConfig().max_speed_m_s + 1e-9
    assert np.linalg.norm(steps, axis=1).max() / DT < OrbitConfig().max_speed_m_s * 1.05


def test_reference_waits_for_a_vehicle_that_stands_still():
    config = OrbitConfig()
    vehicle = np.array([6.0, 0.0, 2.5])
    state = begin_orbit(vehicle, np.zeros(3), config)
    for _ in range(400):
        state = advance(state, goal_of(config), Scene(vehicle, np.zeros(3), np.zeros(3)), DT, config)
    assert np.linalg.norm(reference_position(state) - vehicle) <= 1.3 * config.max_lead_m + 0.1
    sent = setpoint_of(state, Scene(vehicle, np.zeros(3), np.zeros(3)), config)
    assert np.linalg.norm(sent.position - vehicle) <= config.max_lead_m + 1e-9


def test_a_lag_along_the_orbit_takes_nothing_from_the_way_to_the_radius():
    state = begin_orbit(np.array([6.0, 0.0, 2.5]), np.zeros(3), OrbitConfig())
    for behind in (0.0, 0.3, 0.6):  # rad; the vehicle is 1 m too near
        vehicle = np.array([5.0 * math.cos(behind), -5.0 * math.sin(behind), 2.5])
        sent = setpoint_of(state, Scene(vehicle, np.zeros(3), np.zeros(3)), OrbitConfig())
        outward = np.array([math.cos(behind), -math.sin(behind), 0.0])
        assert (sent.position - vehicle) @ outward == pytest.approx(1.0)
        assert np.linalg.norm(sent.position - vehicle) <= OrbitConfig().max_lead_m + 1e-9


def test_the_angle_yields_where_a_vehicle_falls_behind_a_walking_subject():
    config = OrbitConfig()
    state = begin_orbit(np.array([6.0, 0.0, 2.5]), np.zeros(3), config)
    speed = np.array([0.0, 1.4, 0.0])
    for i in range(400):
        subject, angle = speed * i * DT, -math.radians(9.0) * i * DT
        vehicle = subject + np.array([6.0 * math.cos(angle), 6.0 * math.sin(angle), 2.5])
        state = advance(state, goal_of(config), Scene(vehicle, subject, speed), DT, config)
    assert np.linalg.norm(reference_position(state) - vehicle) <= config.max_lead_m + 0.1


def test_larger_radius_reduces_angular_speed_to_the_acceleration_limit():
    config = OrbitConfig(radius_m=4.0, angular_speed_deg_s=40.0)
    _, state, _ = fly(30, config=config, start=(15.0, 0, 2.5))[20]
    assert abs(state.omega.value) ** 2 * state.radius.value <= config.max_acceleration_m_s2 * 1.02
    _, state, _ = fly(40, config=config, start=(15.0, 0, 2.5))[-1]
    assert math.degrees(state.omega.value) == pytest.approx(40, abs=0.5)


def test_clockwise_orbit_mirrors_the_counter_clockwise_one():
    left = fly(10, start=(7.0, 0, 2.5))[-1][2]
    right = fly(10, config=OrbitConfig(angular_speed_deg_s=-19.0), start=(7.0, 0, 2.5))[-1][2]
    assert np.allclose(left.position * [1, -1, 1], right.position)
    assert left.yaw_rate == pytest.approx(-right.yaw_rate)


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 12), st.floats(3.5, 20), st.floats(-60, 60),
    st.integers(0, 2**31),
)  # fmt: skip
def test_limits_hold_for_any_start_and_subject(x, y, z, radius, speed, seed):
    config = OrbitConfig()
    try:
        goal = goal_of(config, radius, 3.0, speed)
    except InputError:
        return
    rng = np.random.default_rng(seed)
    places = np.cumsum(rng.normal(0, 0.3, (200, 3)), axis=0)
    vehicle = np.array([x, y, z])
    state = begin_orbit(vehicle, places[0], config)
    for place in places:
        state = advance(state, goal, Scene(vehicle, place, rng.normal(0, 3, 3)), DT, config)
        sent = setpoint_of(state, Scene(vehicle, place, np.zeros(3)), config)
        assert sent.is_finite()
        assert np.linalg.norm(sent.velocity) <= config.max_speed_m_s + 1e-9
        assert np.linalg.norm(sent.acceleration) <= config.max_acceleration_m_s2 + 1e-9
        assert np.linalg.norm(sent.position - vehicle) <= config.max_lead_m + 1e-9
        vehicle = sent.position


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"radius_m": -1.0}, "radius_m"),
        ({"radius_m": 3.2}, "min_distance_m"),
        ({"radius_m": 50.0}, "max_distance_m"),
        ({"angular_speed_deg_s": 50.0}, "max_speed_m_s"),
        ({"radius_m": 4.0, "angular_speed_deg_s": 45.0}, "max_acceleration_m_s2"),
        ({"max_jerk_m_s3": 0.0}, "max_jerk_m_s3"),
        ({"ramp_s": 0.0}, "ramp_s"),
    ],
)
def test_contradicting_orbit_parameters_are_refused(values, word):
    with pytest.raises(InputError, match=word) as error:
        OrbitConfig(**values)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "turns_s"),
    [({"reverse_every_s": 20.0}, [20.0, 40.0]), ({"calibrate_telemetry": True}, [15.0]), ({}, [])],
)
def test_orbit_turns_its_direction_inside_all_limits(changes, turns_s):
    config = OrbitConfig(**changes)
    state = begin_orbit(np.array([6.0, 0.0, 2.5]), np.zeros(3), config)
    omega, places, accelerations = [], [], []
    for _ in range(int(55 / DT)):
        vehicle = reference_position(state)
        state = advance(state, goal_of(config), Scene(vehicle, np.zeros(3), np.zeros(3)), DT, config)
        setpoint = setpoint_of(state, Scene(vehicle, np.zeros(3), np.zeros(3)), config)
        omega.append(math.degrees(state.omega.value))
        places.append(reference_position(state)[:2])
        accelerations.append(np.linalg.norm(setpoint.acceleration))
    changed = [(i + 1) * DT for i in range(len(omega) - 1) if omega[i] * omega[i + 1] < 0]
    assert len(changed) == len(turns_s)
    assert all(0 < at - turn < 4.0 for at, turn in zip(changed, turns_s, strict=True))
    assert max(omega) == pytest.approx(19.0, abs=0.5)
    assert abs(min(omega) + 19.0 * bool(turns_s)) < 0.5
    assert np.abs(np.diff(omega)).max() < 1.5 * 19.0 / config.ramp_s * 2.5 * DT
    assert max(accelerations) <= config.max_acceleration_m_s2
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() / DT < 2.05


def test_nan_in_a_command_keeps_the_present_value():
    config = OrbitConfig()
    goal = goal_of(config, radius_m=8.0)
    assert goal.height_m == 2.5
    assert goal_of(config, height_m=4.0, present=goal) == (8.0, 4.0, goal.angular_speed_rad_s)
