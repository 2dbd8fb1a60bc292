"""The flight simulator without ROS, stepped in simulated time."""

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import compare, load_truth
from drocap_ros.motion import load_motion
from drocap_ros.simulation.flight_simulator.truth import (
    FlightTruth,
    load_flight_truth,
    orbit_quality,
    save_flight_truth,
)
from drocap_ros.simulation.flight_simulator.world import (
    BEGINS_AFTER_S,
    ActingPerson,
    FlightSimulatorConfig,
    FlightWorld,
)
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport
from drocap_ros.skeleton import BODY_17
from lab.simulation.orbit import look_at

ON_GROUND, IN_AIR, TAKING_OFF = 1, 2, 3


class Clock:
    t = 0.0


def world(**values):
    clock = Clock()
    ways = [Channel(lambda: clock.t, seed) for seed in (1, 2)]
    return clock, FlightWorld(FlightSimulatorConfig(**values), LoopbackTransport(*ways))


def fly(clock, flight, until_s, each=lambda: None):
    while clock.t < until_s - 1e-9:
        clock.t = round(clock.t + 0.01, 6)
        flight.step(clock.t)
        each()


@pytest.mark.parametrize(("autopilot", "mode"), [("ardupilot", "GUIDED"), ("px4", "LOITER")])
def test_pilot_takes_off_hovers_and_hands_over(autopilot, mode):
    clock, flight = world(autopilot=autopilot, wind_m_s=6.0, seed=3)
    start = flight.copter.body.position.copy()
    fly(clock, flight, 0.9)
    assert (flight.copter.armed, flight.copter.landed_state) == (False, ON_GROUND)
    np.testing.assert_array_equal(flight.copter.body.position, start)
    fly(clock, flight, 2.0)
    assert (flight.copter.armed, flight.copter.landed_state) == (True, TAKING_OFF)
    assert not flight.pilot.handed_over
    fly(clock, flight, 10.0, lambda: flight.expose(round(clock.t * 1e9)))
    truth = flight.truth()
    assert ((truth.keypoints > 0) & (truth.keypoints < truth.image_size)).all()  # the person stays in view
    assert (flight.pilot.handed_over, flight.copter.landed_state, flight.copter.mode) == (True, IN_AIR, mode)
    assert np.linalg.norm(flight.copter.body.velocity) < 0.3


@pytest.mark.parametrize(
    "autopilot",
    [
        "ardupilot",
        pytest.param("px4", marks=pytest.mark.xfail(reason="its estimate wanders as the recorded one", strict=True)),
    ],
)
def test_pilot_hovers_where_he_took_off(autopilot):
    clock, flight = world(autopilot=autopilot, wind_m_s=6.0, seed=3)
    start = flight.copter.body.position.copy()
    fly(clock, flight, 10.0)
    assert abs(flight.copter.body.position[2] - 3.0) < 0.6
    assert np.linalg.norm(flight.copter.body.position[:2] - start[:2]) < 1.0


@pytest.mark.parametrize(("mount", "number"), [("servo", 1), ("fixed", 0)])
def test_the_camera_leans_with_the_body_without_a_gimbal(mount, number):
    clock, flight = world(mount=mount, wind_m_s=6.0, seed=3)
    fly(clock, flight, 9.0)
    assert flight.copter.settings["MNT1_TYPE"] == number
    truth = flight.expose(round(clock.t * 1e9)).rotation
    right = np.degrees(np.arcsin(truth[0, 2]))  # the camera's right above the horizon
    assert 1.0 < abs(right) < 25.0  # it leans against the wind
    down = np.degrees(np.arcsin(truth[2, 2]))
    assert -35.0 < down < 0.0


def test_person_moves_while_setpoints_steer_the_vehicle_and_the_truth_records_it():
    clock, flight = world(seed=1, action="walk")

    def setpoint():
        flight.copter.accepted_setpoints += 1

    fly(clock, flight, 8.0)
    before = flight.expose(1_000)
    fly(clock, flight, 8.0 + BEGINS_AFTER_S, setpoint)
    still = flight.expose(2_000)
    np.testing.assert_array_equal(before.joints3d, still.joints3d)
    fly(clock, flight, 8.0 + BEGINS_AFTER_S + 6.0, setpoint)
    after = flight.expose(3_000)
    walked = np.linalg.norm((after.joints3d - still.joints3d)[0, :2])
    assert 2.0 < walked < 8.0
    fly(clock, flight, clock.t + 3.0)  # no more setpoints
    waiting = flight.expose(4_000)
    fly(clock, flight, clock.t + 1.0)
    assert np.abs(flight.expose(5_000).joints3d - waiting.joints3d).max() < 0.005
    truth = flight.truth()
    np.testing.assert_array_equal(truth.stamp_ns, [1_000, 2_000, 3_000, 4_000, 5_000])
    np.testing.assert_array_equal(truth.camera_position[2], after.position)
    np.testing.assert_array_equal(truth.joints3d[2], after.joints3d)


def test_take_equals_the_simulated_person_across_its_pieces():
    config = FlightSimulatorConfig(seed=1, action="mixed")
    take, times = ActingPerson(config), np.array([0.0, 0.123, 19.996, 20.0, 47.3])
    exact = simulate_person(times, "mixed", 1, config.stature_m, BODY_17)
    assert np.abs(np.array([take.at(t) for t in times]) - exact).max() < 0.002


def orbit_truth(seconds=10.0, radius=6.0, speed_deg_s=20.0, off_deg=0.0, rate=10):
    t = np.arange(int(seconds * rate)) / rate
    joints = np.repeat(simulate_person(np.zeros(1), "stand", 0), len(t), axis=0)
    angle = np.radians(speed_deg_s) * t
    centre = joints[:, 0]
    position = centre + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(len(t), 1.6)], axis=1)
    aim = np.arctan2(-np.sin(angle), -np.cos(angle)) + np.radians(off_deg)
    target = position + np.stack([radius * np.cos(aim), radius * np.sin(aim), np.full(len(t), -1.6)], axis=1)
    stamps = (1_000_000_000 + t * 1e9).astype(np.int64)
    matrix = pinhole_matrix(1280, 720, 60.0)
    return FlightTruth(stamps, joints, look_at(position, target), position, matrix, (1280, 720))


def test_orbit_quality_equals_the_constructed_errors():
    truth = orbit_truth(radius=6.4, off_deg=3.0)
    found = orbit_quality(truth, np.ones(100, bool), 6.0)
    assert found.radius_error_m == pytest.approx(0.4)
    assert found.yaw_error_deg == pytest.approx(3.0)
    assert found.in_middle_third == 1.0
    assert found.least_distance_m == pytest.approx(6.4)
    assert found.top_speed_m_s == pytest.approx(6.4 * np.radians(20.0), rel=1e-3)
    assert found.turned_deg == pytest.approx(20.0 * 9.9, abs=0.1)
    half = orbit_quality(truth, np.arange(100) < 50, 6.4)
    assert (half.exposures, round(half.turned_deg)) == (50, 98)
    # 12 deg beside the middle of 60 deg across is outside the middle third.
    assert orbit_quality(orbit_truth(off_deg=12.0), np.ones(100, bool), 6.0).in_middle_third == 0.0
    with pytest.raises(InputError, match="two exposures"):
        orbit_quality(truth, np.zeros(100, bool), 6.0)


def test_truth_file_is_a_motion_and_reads_back(tmp_path):
    truth = orbit_truth()
    save_flight_truth(tmp_path / "truth.npz", truth)
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]
    again = load_flight_truth(tmp_path / "truth.npz")
    for name in ("stamp_ns", "joints3d", "camera_rotation", "camera_position", "camera_matrix", "image_size"):
        np.testing.assert_array_equal(getattr(again, name), getattr(truth, name))
    errors = compare(load_motion(tmp_path / "truth.npz"), *load_truth(tmp_path / "truth.npz"))
    assert errors.frames == 100
    assert errors.error_mm < 1e-6
    with np.load(tmp_path / "truth.npz") as arrays:
        kept = {name: arrays[name] for name in arrays.files if name != "camera_position"}
    np.savez(tmp_path / "less.npz", **kept)
    with pytest.raises(InputError, match="camera_position"):
        load_flight_truth(tmp_path / "less.npz")
