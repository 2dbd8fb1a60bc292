"""The camera's attitude from each kind of mount, in one sign convention: pitch positive up, as in MAVLink."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from drocap_ros.flight.conditions import ConditionCode
from drocap_ros.flight.mavlink.reports import Mount
from drocap_ros.flight.vehicle import orientation_to_aviation, orientation_to_ros, quaternion_from_euler

S = 1_000_000_000
#: As ArduPilot sends it for every mount: roll and pitch "locked", yaw from the nose.
FLAGS = 4 | 8 | 32
NOSE_DOWN = quaternion_from_euler(math.radians(5.0), math.radians(-8.0), math.radians(70.0))  # body FRD -> NED


def report(roll_deg, pitch_deg, yaw_deg, flags=FLAGS):
    x, y, z, w = quaternion_from_euler(*np.deg2rad([roll_deg, pitch_deg, yaw_deg]))
    return mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, flags, [w, x, y, z], 0, 0, 0, 0)


def pitch_deg(camera_xyzw):
    """Elevation of the line of sight; negative = down."""
    return math.degrees(math.asin(Rotation.from_quat(camera_xyzw).apply([1, 0, 0])[2]))


@pytest.mark.parametrize("servos", [None, False])
def test_angles_of_a_gimbal_are_against_the_horizon(servos):
    mount = Mount()
    mount.servos = servos
    mount.take(report(0, -20, 0), S)
    assert mount.kind == "gimbal"
    camera = mount.camera_at(NOSE_DOWN, S)
    assert pitch_deg(camera) == pytest.approx(-20.0)
    expected = orientation_to_ros(quaternion_from_euler(0.0, math.radians(-20), math.radians(70)))
    assert np.allclose(camera, expected)


@pytest.mark.parametrize(("kind", "servos"), [("auto", True), ("servo", None), ("servo", False)])
def test_angles_of_servos_are_against_the_body(kind, servos):
    mount = Mount(kind)
    mount.servos = servos
    mount.take(report(-5, -12, 0), S)
    assert mount.kind == "servo"
    expected = Rotation.from_quat(NOSE_DOWN) * Rotation.from_euler("ZYX", [0, -12, -5], degrees=True)
    camera = Rotation.from_quat(orientation_to_aviation(mount.camera_at(NOSE_DOWN, S)))
    assert np.degrees((camera.inv() * expected).magnitude()) < 1e-6
    assert pitch_deg(mount.camera_at(NOSE_DOWN, S)) == pytest.approx(-20.0, abs=0.1)  # nose -8, servo -12


def test_a_fixed_camera_leans_with_the_body_and_looks_down_at_a_negative_pitch():
    mount = Mount("fixed", -30.0)
    level = quaternion_from_euler(0.0, 0.0, 0.0)
    assert pitch_deg(mount.camera_at(level, S)) == pytest.approx(-30.0)
    assert pitch_deg(mount.camera_at(quaternion_from_euler(0.0, math.radians(-8), 2.0), S)) == pytest.approx(-38.0)
    assert mount.age_s(10 * S) == 0.0


def test_without_a_report_the_camera_is_unknown():
    mount = Mount()
    assert mount.kind == ""
    assert np.isnan(mount.camera_at(NOSE_DOWN, S)).all()
    assert mount.age_s(S) == math.inf
    mount.take(report(0, -20, 0), S)
    assert np.isfinite(mount.camera_at(NOSE_DOWN, 3 * S)).all()
    assert np.isnan(mount.camera_at(NOSE_DOWN, 5 * S)).all()  # silent: not replaced by a guess
    assert mount.kind == "gimbal"


def test_a_mount_that_reports_no_angles_is_outdated_sooner_than_a_silent_one():
    mount = Mount("gimbal")
    mount.take(report(0, -20, 0), S)
    unknown = mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, 0, FLAGS, [math.nan] * 4, 0, 0, 0, 0)
    assert mount.problem("px4", round(2.9 * S)) is None
    mount.take(unknown, round(1.1 * S))
    assert mount.problem("px4", round(1.4 * S)) is None  # a few are lost
    assert mount.problem("px4", round(1.6 * S)).code == ConditionCode.MOUNT_OUTDATED
    assert np.isnan(mount.camera_at(NOSE_DOWN, round(1.6 * S))).all()
    mount.take(report(0, -20, 0), round(1.7 * S))
    assert mount.problem("px4", round(2.3 * S)) is None
