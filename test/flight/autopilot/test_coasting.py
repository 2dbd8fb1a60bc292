"""The predicted coast against recorded flights of the real autopilots whose bridge was killed."""

import math

import numpy as np
import pytest

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.orbit.speed import greatest_speed

ARDUPILOT = [f"bridge_killed_timeout_{timeout}s_{i}" for timeout, n in (("0.3", 3), ("0.5", 5)) for i in range(n)]
PX4 = [f"px4_bridge_sigkill_{i}" for i in range(3)]


def recorded(shared_files, name):
    """Prediction, places (N, 2) since the last setpoint until slower than 0.5 m/s, their times, farthest place (m)."""
    flight = np.load(shared_files / "flight" / f"{name}.npz")
    start = flight["setpoint_time_s"][-1]
    after = flight["time_s"] >= start
    times, places = flight["time_s"][after] - start, flight["position_m"][after][:, :2]
    speeds = np.linalg.norm(flight["velocity_m_s"][after], axis=1)
    stands = int(np.argmax((speeds < 0.5) & (times > 0.5)))
    parts = ("position_m", "velocity_m_s", "acceleration_m_s2")
    last = Setpoint(*(flight[f"setpoint_{part}"][-1] for part in parts), 0.0, 0.0)
    px4, timeout_s = name.startswith("px4"), 0.3 if "timeout_0.3" in name else 0.5
    first = (flight[name][after][0] for name in ("position_m", "velocity_m_s"))
    coast = autopilot_of("px4" if px4 else "ardupilot").coast_of(last, *first, timeout_s)
    farthest = float(np.linalg.norm(places - places[0], axis=1).max())
    return coast, places[:stands], times[:stands], farthest


@pytest.mark.parametrize("name", ARDUPILOT + PX4)
def test_prediction_agrees_with_the_recorded_flight(shared, name):
    coast, places, times, farthest = recorded(shared, name)
    real, braking = float(np.linalg.norm(places - places[0], axis=1).max()), coast.length_m - coast.creep_m
    print(f"{name:32s} predicted {braking:.2f} + {coast.creep_m:.2f} m, flown {real:.2f}, at last {farthest:.2f} m")
    assert 0.82 * real < braking < 1.3 * real
    assert 0.82 * farthest < coast.length_m
    predicted = np.interp(times, coast.time_s, coast.place.real), np.interp(times, coast.time_s, coast.place.imag)
    assert np.hypot(predicted[0] - places[:, 0], predicted[1] - places[:, 1]).max() < 1.0


def steady(speed, autopilot="ardupilot", acceleration=0.0):
    velocity, zero = np.array([speed, 0.0, 0.0]), np.zeros(3)
    last = Setpoint(zero, velocity, np.array([0.0, acceleration, 0.0]), 0.0, 0.0)
    return autopilot_of(autopilot).coast_of(last, zero, velocity, 0.5)


def test_noise_of_the_acceleration_lengthens_the_coast():
    assert steady(2.0, acceleration=2.0).length_m > steady(2.0, acceleration=0.66).length_m + 0.3


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_greatest_speed_stops_within_the_distance(autopilot):
    speed = greatest_speed(autopilot_of(autopilot), 0.5, 2.5)
    assert 1.5 < speed < 2.5  # PX4 creeps on after its stop
    assert steady(speed, autopilot).length_m == pytest.approx(2.5, abs=0.05)
    assert greatest_speed(autopilot_of(autopilot), 0.3, 2.5) > speed > greatest_speed(autopilot_of(autopilot), 1.0, 2.5)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_vehicle_at_rest_stays(autopilot):
    assert steady(0.0, autopilot).length_m == 0.0
    assert math.isfinite(steady(0.0, autopilot).time_s[-1])


def test_acceleration_lengthens_the_coast_of_px4():
    velocity, zero = np.array([1.2, 0.0, 0.0]), np.zeros(3)
    plain, pushed = (Setpoint(zero, velocity, np.array([a, 0.0, 0.0]), 0.0, 0.0) for a in (0.0, 0.8))
    lengths = [autopilot_of("px4").coast_of(last, zero, velocity, 0.5).length_m for last in (plain, pushed)]
    assert lengths[1] > lengths[0] + 0.1


def test_a_place_far_ahead_lengthens_the_coast_of_px4():
    velocity, zero = np.array([1.2, 0.0, 0.0]), np.zeros(3)
    near, far = (Setpoint(np.array([way, 0.0, 0.0]), velocity, zero, 0.0, 0.0) for way in (0.4, 1.4))
    lengths = [autopilot_of("px4").coast_of(last, zero, velocity, 0.5).length_m for last in (near, far)]
    assert lengths[1] > lengths[0] + 0.5


@pytest.mark.parametrize("push", [(0.6, 0.0), (0.0, 0.8), (0.3, -0.5)])
def test_until_the_time_out_ardupilot_flies_on_along_the_parabola_of_its_setpoint(push):
    velocity, zero = np.array([1.2, 0.3, 0.0]), np.zeros(3)
    last = Setpoint(zero, velocity, np.array([*push, 0.0]), 0.0, 0.0)
    how = autopilot_of("ardupilot").coasting
    coast = autopilot_of("ardupilot").coast_of(last, zero, velocity, 0.5)
    for t, place in zip(coast.time_s, coast.place, strict=True):
        if t <= 0.5:
            flown = complex(*velocity[:2]) * t + 0.5 * complex(*push) * t**2
            assert abs(place - how.excess * flown) < 0.02
