"""PX4 follows its wandering estimate: off its setpoints by 0.26 m (RMS) within 4 s in recorded orbits.

Where its reports were recorded, too (``t3_*``), it is off by 0.5 m per axis: the error of
its velocity alone moves it by 0.26 m.
"""

import numpy as np
import pytest

from drocap_ros.flight.autopilot.px4 import PX4
from drocap_ros.simulation.vehicle.dynamics import Body, EstimateError
from drocap_ros.simulation.vehicle.flight_control import Manner, Target, control_of
from lab.flights.replay import Case, load_recorded, replay


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
