import itertools
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from drocap_ros.flight.mavlink.parser import MavlinkParser
from drocap_ros.flight.mavlink.state_estimator import VehicleStateEstimator

S = 1_000_000_000


class Sender:
    """Messages of one system as they arrive: packed and parsed."""

    def __init__(self, system=1, component=1):
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.parser = MavlinkParser()

    def __call__(self, name, *args, **kwargs):
        packet = getattr(self.mav, name + "_encode")(*args, **kwargs).pack(self.mav)
        return self.parser.feed(packet)[0]


def heartbeat(sender, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mode=4, armed=True, kind=2):
    return sender("heartbeat", kind, autopilot, 1 | (128 if armed else 0), mode, 4)


def see(estimator, sender, *args, **kwargs):
    estimator.update(attitude(sender, *args, **kwargs), 10 * S)
    return estimator.snapshot(10 * S)


def attitude(sender, ms=1000, q=(1, 0, 0, 0), rates=(0, 0, 0)):
    return sender("attitude_quaternion", ms, *q, *rates)


@pytest.fixture
def ready():
    estimator, sender = VehicleStateEstimator(), Sender()
    estimator.update(heartbeat(sender), 10 * S)
    return estimator, sender


def test_no_state_before_the_first_heartbeat():
    estimator, sender = VehicleStateEstimator(), Sender()
    assert estimator.update(attitude(sender), S) is None
    assert estimator.snapshot(S) is None


def test_attitude_alone_gives_a_state_with_unknown_fields(ready):
    estimator, sender = ready
    state = estimator.update(attitude(sender, q=(1, 0, 0, 0), rates=(0.1, 0.2, 0.3)), 10 * S)
    assert (state.autopilot, state.mode, state.armed) == ("ardupilot", "GUIDED", True)
    assert np.allclose(Rotation.from_quat(state.orientation_xyzw).apply([1, 0, 0]), [0, 1, 0])  # nose north
    assert np.allclose(state.angular_velocity_flu_rad_s, [0.1, -0.2, -0.3])
    assert np.isnan(state.position_enu_m).all()
    assert np.isnan(state.gimbal_orientation_xyzw).all()
    assert math.isnan(state.latitude_deg)
    assert math.isnan(state.battery_fraction)
    assert state.satellites == 255
    assert not state.position_ok


def test_mode_names_of_both_autopilots():
    for autopilot, mode, name, kind in (
        (3, 5, "LOITER", "ardupilot"),
        (12, 6 << 16, "OFFBOARD", "px4"),
        (4, 1, None, "other"),
    ):
        estimator, sender = VehicleStateEstimator(), Sender()
        estimator.update(heartbeat(sender, autopilot, mode), S)
        state = estimator.update(attitude(sender), S)
        assert state.autopilot == kind
        assert name is None or state.mode == name


def test_position_is_enu_and_extrapolated_to_the_attitude(ready):
    estimator, sender = ready
    estimator.update(sender("local_position_ned", 1000, 1, 2, -3, 10, 0, 0), 10 * S)
    state = estimator.update(attitude(sender, 1200), 10 * S + S // 5)
    assert np.allclose(state.position_enu_m, [2, 1 + 10 * 0.2, 3], atol=1e-5)
    assert np.allclose(state.velocity_enu_m_s, [0, 10, 0])


def test_only_a_fresh_range_finder_that_looks_down_and_is_in_range_tells_the_clearance(ready):
    estimator, sender = ready
    down, ahead = mavlink.MAV_SENSOR_ROTATION_PITCH_270, mavlink.MAV_SENSOR_ROTATION_NONE

    def clearance(centimetres, orientation, age_s=0.1):
        message = sender("distance_sensor", 1000, 20, 4000, centimetres, 0, 1, orientation, 255)
        estimator.update(message, 10 * S)
        return estimator.clearance_m(10 * S + int(age_s * S))

    assert math.isnan(estimator.clearance_m(10 * S))
    assert clearance(250, down) == 2.5
    assert clearance(900, ahead) == 2.5
    assert math.isnan(clearance(250, down, age_s=1.5))
    assert math.isnan(clearance(4000, down))
    assert math.isnan(clearance(10, down))


def test_nothing_but_an_attitude_gives_a_state(ready):
    """A clock that has jumped gives the attitude before another stamp: it is the same state nevertheless."""
    estimator, sender = ready
    others = [
        sender("local_position_ned", 2000, 1, 2, -3, 1, 0, 0),
        sender("global_position_int", 2000, 10, 20, 30, 0, 0, 0, 0, 0),
        sender("gps_raw_int", 2_000_000, 3, 10, 20, 30, 0, 0, 0, 0, 9),
        sender("sys_status", 0, 0, 0, 0, 12_000, 0, 90, 0, 0, 0, 0, 0, 0),
        sender("extended_sys_state", 0, 1),
        sender("distance_sensor", 2000, 20, 4000, 300, 0, 1, mavlink.MAV_SENSOR_ROTATION_PITCH_270, 255),
        Sender(component=154)("gimbal_device_attitude_status", 0, 0, 2000, 32, (1, 0, 0, 0), 0, 0, 0, 0),
    ]
    for i, message in enumerate(others):
        assert estimator.update(attitude(sender, 1000 + i), (20 + 20 * i) * S) is not None
        estimator.update(sender("system_time", 0, 1000 + i), (30 + 20 * i) * S)
        assert estimator.update(message, (30 + 20 * i) * S) is None


def test_old_position_is_unknown(ready):
    estimator, sender = ready
    estimator.update(sender("local_position_ned", 1000, 1, 2, -3, 1, 0, 0), 10 * S)
    state = estimator.update(attitude(sender, 6000), 15 * S)
    assert np.isnan(state.position_enu_m).all()


def test_global_position_replaces_a_missing_local_one(ready):
    estimator, sender = ready
    estimator.update(sender("global_position_int", 1000, 474000000, 85000000, 500000, 20000, 0, 0, 0, 0), 10 * S)
    estimator.update(
        sender("global_position_int", 1200, 474001000, 85000000, 501000, 21000, 0, 0, 0, 0), 10 * S + S // 5
    )
    state = estimator.update(attitude(sender, 1200), 10 * S + S // 5)
    assert np.allclose(state.position_enu_m, [0, 11.12, 21], atol=0.02)
    assert np.isclose(state.latitude_deg, 47.4001)
    assert np.isclose(state.altitude_amsl_m, 501)


@pytest.mark.parametrize(
    ("flags", "ok"),
    [
        (831, True),
        (831 | 128, False),
        (831 & ~1, False),
        (831 & ~2, False),
        (831 & ~(8 | 16), False),
        (831 | 32768, False),
        (0, False),
    ],
)
def test_estimator_health(ready, flags, ok):
    estimator, sender = ready
    estimator.update(sender("local_position_ned", 1000, 0, 0, -3, 0, 0, 0), 10 * S)
    estimator.update(sender("ekf_status_report", flags, 0, 0, 0, 0, 0), 10 * S)
    assert estimator.update(attitude(sender), 10 * S).position_ok is ok


def test_outdated_estimator_health_is_unhealthy(ready):
    estimator, sender = ready
    estimator.update(sender("ekf_status_report", 831, 0, 0, 0, 0, 0), 10 * S)
    estimator.update(sender("local_position_ned", 7000, 0, 0, -3, 0, 0, 0), 16 * S)
    assert estimator.update(attitude(sender, 7000), 16 * S).position_ok is False


def test_status_values(ready):
    estimator, sender = ready
    estimator.update(sender("gps_raw_int", 0, 3, 0, 0, 0, 0, 0, 0, 0, 14), 10 * S)
    estimator.update(sender("sys_status", 0, 0, 0, 0, 15200, 0, 63, 0, 0, 0, 0, 0, 0), 10 * S)
    estimator.update(sender("extended_sys_state", 0, 2), 10 * S)
    state = estimator.update(attitude(sender), 10 * S)
    assert (state.gps_fix_type, state.satellites, state.landed_state) == (3, 14, 2)
    assert np.isclose(state.battery_voltage_v, 15.2)
    assert np.isclose(state.battery_fraction, 0.63)
    estimator.update(sender("sys_status", 0, 0, 0, 0, 65535, 0, -1, 0, 0, 0, 0, 0, 0), 10 * S)
    state = see(estimator, sender)
    assert math.isnan(state.battery_voltage_v)
    assert math.isnan(state.battery_fraction)


def test_gimbal_yaw_from_north_and_from_the_nose(ready):
    estimator, sender = ready
    gimbal = Sender(component=154)
    half = math.sqrt(0.5)
    estimator.update(attitude(sender, q=(half, 0, 0, half)), 10 * S)  # nose east
    down = (math.cos(-0.25), 0.0, math.sin(-0.25), 0.0)  # pitch -0.5 rad
    for flags, ahead in ((32, [1, 0]), (64, [0, 1]), (0, [1, 0]), (16, [0, 1])):
        estimator.update(gimbal("gimbal_device_attitude_status", 0, 0, 1000, flags, down, 0, 0, 0, 0), 10 * S)
        state = see(estimator, sender, q=(half, 0, 0, half))
        axis = Rotation.from_quat(state.gimbal_orientation_xyzw).apply([1, 0, 0])
        assert np.allclose(axis[:2], math.cos(0.5) * np.array(ahead), atol=1e-6)
        assert np.isclose(axis[2], -math.sin(0.5))


def test_turning_gimbal_is_extrapolated_to_the_attitude(ready):
    estimator, sender = ready
    gimbal = Sender(component=154)
    for i, yaw in enumerate((0.0, 0.02)):  # 50 ms apart
        q = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        message = gimbal("gimbal_device_attitude_status", 0, 0, 7, 64, q, 0, 0, 0, 0)  # with a clock of its own
        estimator.update(message, 10 * S + i * S // 20)
    for after_ms, expected in ((0, 0.02), (20, 0.028), (40, 0.036), (500, 0.04)):
        now = 10 * S + S // 20 + after_ms * S // 1000
        state = estimator.update(attitude(sender, 1000 + after_ms), now)
        forward = Rotation.from_quat(state.gimbal_orientation_xyzw).apply([1, 0, 0])
        assert np.isclose(np.arctan2(forward[0], forward[1]), expected, atol=1e-6)
    state = estimator.update(attitude(sender, 9000), 18 * S)
    assert np.isnan(state.gimbal_orientation_xyzw).all()


def test_old_and_new_mount_messages_agree(ready):
    estimator, sender = ready
    estimator.update(attitude(sender), 10 * S)
    axes = []
    for message in (
        sender("mount_orientation", 1000, 0.0, -20.0, 30.0, 30.0),
        sender("mount_orientation", 1000, 0.0, -20.0, 30.0),
        sender("mount_status", 0, 0, -2000, 0, 3000),
    ):
        estimator.update(message, 10 * S)
        state = see(estimator, sender)
        axes.append(Rotation.from_quat(state.gimbal_orientation_xyzw).apply([1, 0, 0]))
    pitch, yaw = np.deg2rad([-20, 30])
    expected = [np.cos(pitch) * np.sin(yaw), np.cos(pitch) * np.cos(yaw), np.sin(pitch)]
    assert np.allclose(axes, expected, atol=1e-6)


def test_quaternion_replaces_angles_so_each_instant_gives_one_state(ready):
    estimator, sender = ready
    assert estimator.update(sender("attitude", 900, 0, 0, 0, 0, 0, 0), 9 * S) is not None
    assert estimator.update(attitude(sender), 10 * S) is not None
    assert estimator.update(sender("attitude", 1100, 1, 0, 0, 0, 0, 0), 10 * S + S // 10) is None
    assert estimator.update(sender("attitude", 4000, 0, 0, 0, 0, 0, 0), 13 * S) is not None


def test_angles_and_quaternion_agree(ready):
    estimator, sender = ready
    a = estimator.update(sender("attitude", 900, 0.1, -0.2, 2.5, 0, 0, 0), 10 * S)
    q = Rotation.from_euler("ZYX", [2.5, -0.2, 0.1]).as_quat()
    b = see(estimator, sender, q=(q[3], *q[:3]))
    assert np.isclose(abs(a.orientation_xyzw @ b.orientation_xyzw), 1, atol=1e-6)


def test_other_systems_and_components_are_ignored(ready):
    estimator, _ = ready
    stranger, companion, station = Sender(system=9), Sender(component=191), Sender(system=255, component=190)
    for other in (stranger, companion, station):
        estimator.update(heartbeat(other, mode=9, armed=False), 10 * S)
        assert estimator.update(attitude(other), 10 * S) is None
    state = estimator.update(attitude(Sender()), 10 * S)
    assert state.mode == "GUIDED"
    assert state.armed


def test_ground_station_and_companion_are_no_autopilot():
    estimator = VehicleStateEstimator()
    estimator.update(heartbeat(Sender(255, 190), autopilot=8, kind=6), S)
    estimator.update(heartbeat(Sender(1, 191), autopilot=8, kind=18), S)
    assert estimator.system_id == 0
    estimator.update(heartbeat(Sender(7, 1)), S)
    assert estimator.system_id == 7


def test_configured_vehicle_is_the_only_one():
    estimator = VehicleStateEstimator(target_system_id=2)
    estimator.update(heartbeat(Sender(1)), S)
    assert estimator.update(attitude(Sender(1)), S) is None
    estimator.update(heartbeat(Sender(2)), S)
    assert estimator.update(attitude(Sender(2)), S) is not None


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (math.nan, 0, 0, 0), (5, 0, 0, 0), (math.inf, 0, 0, 0)])
def test_attitude_without_unit_quaternion_is_dropped(ready, q):
    estimator, sender = ready
    assert estimator.update(attitude(sender, q=q), 10 * S) is None


def test_position_that_is_not_finite_is_dropped(ready):
    estimator, sender = ready
    for bad in itertools.islice((math.nan, math.inf, -math.inf), 3):
        estimator.update(sender("local_position_ned", 1000, bad, 0, 0, 0, 0, 0), 10 * S)
    estimator.update(sender("global_position_int", 1000, 2000000000, 0, 0, 0, 0, 0, 0, 0), 10 * S)
    state = estimator.update(attitude(sender), 10 * S)
    assert np.isnan(state.position_enu_m).all()
    assert math.isnan(state.latitude_deg)


def test_stamps_follow_the_autopilots_clock_not_the_arrival(ready):
    estimator, sender = ready
    estimator.clock.exchange(10 * S, 1 * S, 10 * S)
    stamps = [
        estimator.update(attitude(sender, 1000 + 20 * i), 10 * S + i * 20_000_000 + jitter).stamp_ns
        for i, jitter in enumerate([0, 9_000_000, 3_000_000, 15_000_000])
    ]
    assert stamps == [10 * S + 20_000_000 * i for i in range(4)]


def test_link_age_grows_in_silence(ready):
    estimator, sender = ready
    assert estimator.update(attitude(sender), 10 * S).link_age_s == 0
    assert np.isclose(estimator.snapshot(12 * S).link_age_s, 2.0)


def test_a_position_is_as_old_as_its_stamp_says(ready):
    estimator, sender = ready
    assert estimator.position_behind_s() == 0.0
    estimator.update(sender("local_position_ned", 600, 1, 2, -3, 0, 0, 0), 10 * S)
    see(estimator, sender, 1000)
    assert estimator.position_behind_s() == pytest.approx(0.4)
    estimator.update(sender("local_position_ned", 1040, 1, 2, -3, 0, 0, 0), 10 * S)
    assert estimator.position_behind_s() == 0.0
