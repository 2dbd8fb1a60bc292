"""The simulated copter against measurements on ArduPilot Copter (orbit of 6 m at 2 m/s, 20 setpoints per second)."""

import math

import numpy as np
import pytest
from flown_copter import ALL, HEIGHT, RADIUS, SPEED, Flight

from drocap_ros.flight.autopilot.px4 import PX4
from drocap_ros.simulation.vehicle.copter_reports import Body, EstimateError
from drocap_ros.simulation.vehicle.flight_control import Manner, Target, control_of
from lab.flights.replay import Case, load_recorded, replay

NO_YAW_RATE, POSITION_YAW, NO_ACCELERATION, VELOCITY = 2048, 2552, 2496, 1 | 2 | 4 | 64 | 128 | 256 | 1024


def settled(mask=ALL, yaw_from="reference", **world):
    """Radius error m, its mean size, and mean size of the yaw error, deg, over one turn after 10 s."""
    flight = Flight(**world)
    flight.fly(10.0 + 2 * math.pi * RADIUS / SPEED, lambda: flight.orbit(mask, yaw_from))
    rows = np.array(flight.rows)
    rows = rows[rows[:, 0] > 10.0]
    radius = rows[:, 7] - RADIUS
    return float(radius.mean()), float(np.abs(radius).mean()), math.degrees(float(np.abs(rows[:, 8]).mean()))


def stop(how, timeout_s=3.0):
    """Greatest distance from the position at the stop, m."""
    flight = Flight(timeout_s=timeout_s)
    flight.fly(15.04, lambda: flight.orbit(ALL, "vehicle"))  # the stop begins with the next setpoint, or without it
    first, place, yaw = len(flight.rows), flight.copter.body.position.copy(), flight.copter.body.yaw
    if how in ("BRAKE", "LOITER"):
        flight.copter.set_mode(how, "test")
    each = {
        "hold": lambda: flight.send(POSITION_YAW, place, yaw=yaw), "zero": lambda: flight.send(VELOCITY)
    }.get(how, lambda: None)  # fmt: skip
    flight.fly(24.0, each)
    return float(np.linalg.norm(np.array(flight.rows)[first:, 1:4] - place, axis=1).max())


def jump():
    """Greatest speed after a position setpoint 500 m away, m/s."""
    flight = Flight()
    flight.fly(15.0, lambda: flight.send(NO_YAW_RATE, (500.0, 0.0, HEIGHT)))
    return float(np.linalg.norm(np.array(flight.rows)[:, 4:7], axis=1).max())


#: What the setpoint holds, where its yaw points from, and the world; measured radius error m and yaw error deg.
ORBITS = (
    ("position", POSITION_YAW, "reference", {}, 0.06, 19.0),
    ("and velocity", NO_ACCELERATION, "reference", {}, 0.47, 1.8),
    ("and acceleration", NO_YAW_RATE, "reference", {}, 0.12, 2.9),
    ("and yaw rate", ALL, "vehicle", {}, 0.12, 0.9),
    pytest.param(
        "all, wind 8 m/s", ALL, "vehicle", {"wind": 8.0}, 0.16, 1.4,
        marks=pytest.mark.xfail(reason="0.25 m: in wind the simulated vehicle is worse", strict=True),
    ),
    ("all, centre at 1.4 m/s", ALL, "vehicle", {"centre_speed": 1.4}, 0.13, 0.8),
)  # fmt: skip
#: How it is stopped, GUID_TIMEOUT s, measured distance m (from, to).
STOPS = (
    ("hold", 3.0, 1.5, 1.5), ("zero", 3.0, 1.85, 1.85), ("LOITER", 3.0, 2.0, 2.0), ("BRAKE", 3.0, 3.4, 3.4),
    ("silence", 3.0, 7.6, 9.2), ("silence", 0.5, 2.3, 2.3),
)  # fmt: skip


def compare(name, simulated, least, most, rounding):
    """Print both; allow 10 % of the measurement and half of its last digit."""
    print(f"{name:45s} simulated {simulated:5.2f}  measured {least:g}" + (f" to {most:g}" if most > least else ""))
    assert 0.9 * least - rounding <= simulated <= 1.1 * most + rounding, name


@pytest.mark.parametrize(("name", "mask", "yaw_from", "world", "radius", "yaw"), ORBITS)
def test_orbit_errors_equal_the_measured_ones(name, mask, yaw_from, world, radius, yaw):
    signed, size, turned = settled(mask, yaw_from, **world)
    compare(f"{name}: radius error, m", size if world else signed, radius, radius, 0.005)
    compare(f"{name}: yaw error, deg", turned, yaw, yaw, 0.05)


@pytest.mark.parametrize(("how", "timeout_s", "least", "most"), STOPS)
def test_stops_are_as_long_as_the_measured_ones(how, timeout_s, least, most):
    compare(f"stop by {how}, GUID_TIMEOUT {timeout_s:g} s, m", stop(how, timeout_s), least, most, 0.005)


def test_distant_setpoint_is_approached_at_full_speed():
    compare("setpoint 500 m away: speed, m/s", jump(), 9.3, 9.3, 0.05)


@pytest.mark.parametrize(("wind", "least", "most"), [(10.0, 0.0, 0.1), (12.0, 0.6, 2.0)])
def test_a_hold_stands_in_wind_until_the_wind_carries_it_off(wind, least, most):
    """Two recorded ones drift by 0.65 and 0.9 m/s in gusts of 12 m/s."""
    flight = Flight(wind=wind)
    flight.copter.set_mode("BRAKE", "command")
    flight.fly(12.0, lambda: None)
    before, after = np.array(flight.rows[199][1:3]), np.array(flight.rows[-1][1:3])
    assert least <= np.linalg.norm(after - before) / 10.0 <= most


def change_m(path, seconds=4.0):
    """RMS of the horizontal change within some seconds of a path with 100 places a second."""
    step = round(100 * seconds)
    return float(np.sqrt(np.mean(np.sum((path[step:] - path[:-step]) ** 2, axis=1))))


def hover(seed):
    """(N, 2) m, a vehicle that holds a place for a minute by an estimate that errs."""
    error, place, rest = EstimateError(PX4.simulated.horizontal, PX4.simulated.vertical, 1.0, seed), np.zeros(3), []
    body = Body(place, 0.0, np.zeros(3), PX4.simulated.airframe, gust=0.0)
    control = control_of(PX4, error.position, 0.0, body.drag())
    control.begin(Manner.SETPOINTS, error.position, np.zeros(3), 0.0)
    control.take(Target(error.position.copy()))
    for _ in range(6000):
        command = control.command(body.position + error.position, body.velocity + error.velocity, False, 0.01)
        body.step(command, 0.0, 0.01)
        error.step(False, 0.01)
        rest.append(body.position[:2].copy())
    return np.array(rest[500:])


def test_vehicle_wanders_no_less_than_the_recorded_one():
    assert 0.26 <= np.mean([change_m(hover(seed)) for seed in range(8)]) <= 0.54


@pytest.mark.xfail(reason="by errors as in the newest recordings it wanders by 0.46 m", strict=True)
def test_vehicle_wanders_little_more_than_the_first_recorded_one():
    assert np.mean([change_m(hover(seed)) for seed in range(8)]) <= 0.4


@pytest.mark.parametrize("name", ["px4_stand_calm", "px4_walk_calm"])
def test_px4_flies_a_whole_orbit_from_the_setpoints_alone(shared, name):
    flight = load_recorded(shared / "flight" / f"{name}.npz")
    start_s, end_s = (float(flight.setpoint_s[i]) for i in (0, -1))
    got = replay(flight, Case(name, start_s + 4.0), "px4", end_s - start_s - 4.0)
    apart = (got.simulated - got.recorded)[500:]
    assert got.time_s[-1] > 40.0
    assert np.linalg.norm(apart, axis=1).max() < 0.5
    assert 0.2 < change_m(apart) < 0.3  # what its estimate wandered


def test_own_motion_in_wind_is_slowed_down_by_the_recorded_friction():
    body = Body(np.zeros(3), 0.0, np.array([8.0, 0.0, 0.0]), PX4.simulated.airframe)
    rest = body.drag()
    body.velocity = np.array([-1.4, 0.0, 0.0])
    assert body.drag() - rest == pytest.approx(np.array([1.4, 0.0, 0.0]))
    assert rest[0] == pytest.approx(0.016 * 64.0)
