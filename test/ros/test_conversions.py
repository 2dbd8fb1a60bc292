"""Conversions between messages and arrays."""

from array import array
from dataclasses import replace

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.keypoints import Keypoints2D, PoseObservation
from drocap_ros.msg import Pose3D
from drocap_ros.reconstruction.common.poses import DEADLINE
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort, InMap, Window
from drocap_ros.ros import conversions as c
from drocap_ros.skeleton import BODY_15


def observation(seed=0):
    rng = np.random.default_rng(seed)
    keypoints = rng.uniform(0, 700, (15, 2)).astype(np.float32)
    keypoints[3] = np.nan
    return PoseObservation(
        stamp_ns=1_700_000_000_123_456_789,
        track_id=7,
        image_size=(1280, 720),
        roi=np.array([1, 2, 3, 4], np.float32),
        detection_score=0.75,
        keypoints=keypoints,
        covariance=rng.uniform(1, 9, (15, 3)).astype(np.float32),
        confidence=rng.uniform(0, 1, 15).astype(np.float32),
    )


def test_keypoints_keep_every_bit_in_a_message():
    before = observation()
    after = c.pose2d_from_ros(c.pose2d_to_ros(before, "camera"))
    assert (after.stamp_ns, after.track_id, after.joints) == (before.stamp_ns, 7, BODY_15)
    assert after.image_size == (1280, 720)
    for name in ("keypoints", "covariance", "confidence", "roi"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))


def test_an_image_without_a_subject_is_a_message_with_empty_arrays():
    message = c.pose2d_to_ros(PoseObservation(5, 0, (640, 480)), "camera")
    assert len(message.keypoints) == len(message.confidence) == 0
    assert not c.pose2d_from_ros(message).has_subject


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("skeleton", "robot", "skeleton: expected one of"),
        ("keypoints", array("f", [1.0] * 29), "keypoints: expected 30 values"),
        ("keypoints", array("f", [float("inf")] * 30), "infinity"),
        ("keypoints", array("f", [0.0] * 1_000_000), "keypoints: expected 30 values"),
        ("covariance", array("f"), "covariance: expected 45"),
        ("confidence", array("f", [1.0]), "confidence: expected 15"),
        ("keypoints", array("f", [1e30] * 30), r"at most 1e\+06 px"),
        ("covariance", array("f", [1e30] * 45), r"at most 1e\+12 px\^2"),
        ("image_width", 0, "image size"),
    ],
)
def test_a_malformed_message_is_refused_in_one_line(name, value, words):
    message = c.pose2d_to_ros(observation(), "camera")
    setattr(message, name, value)
    with pytest.raises(InputError, match=words) as caught:
        c.pose2d_from_ros(message)
    assert "\n" not in str(caught.value)


def test_a_stamp_before_1970_is_refused():
    message = c.pose2d_to_ros(observation(), "camera")
    message.header.stamp.sec = -5
    with pytest.raises(InputError, match="stamp"):
        c.pose2d_from_ros(message)


def test_a_pose_keeps_every_bit_in_a_message():
    rng = np.random.default_rng(1)
    joints, confidence = rng.normal(size=(15, 3)).astype(np.float32), rng.uniform(size=15).astype(np.float32)
    message = c.pose3d_to_ros(LivePose(9, 1, joints, np.zeros((15, 6)), confidence, 2.0), "camera")
    back = c.pose3d_from_ros(message)
    np.testing.assert_array_equal(back.joints3d, joints)
    np.testing.assert_array_equal(back.confidence, confidence)
    assert (back.stamp_ns, back.track_id, back.refined, message.skeleton) == (9, 1, False, "body15")
    assert np.isnan(message.camera_orientation.w)
    message.joints = array("f", [0.0] * 44)
    with pytest.raises(InputError, match="joints: expected 45"):
        c.pose3d_from_ros(message)


def given(stamp_ns):
    frames = len(stamp_ns)
    return Window(stamp_ns, Keypoints2D(np.zeros((frames, 17, 2))), np.zeros((frames, 17, 3)), track_id=7)


def adjusted(effort):
    frames = 3
    return AdjustedWindow(
        stamp_ns=np.arange(frames) * 10**8,
        joints3d=np.random.default_rng(2).normal(size=(frames, 17, 3)),
        covariance=np.ones((frames, 17, 6)),
        confidence=np.ones((frames, 17)),
        reprojection_rms_px=np.full(frames, 2.0),
        iterations=9,
        cost=4.0,
        stop_reason=DEADLINE,
        cost_terms={},
        effort=effort,
    )


@pytest.mark.parametrize(("steps", "sent"), [(None, []), ((4, 2), [4, 2]), ((0, 3), [0, 3])])
def test_a_window_message_states_its_effort(steps, sent):
    window = adjusted(Effort(2, steps))
    message = c.window_to_ros(given(window.stamp_ns), window, "camera", 5, 0.25)
    assert (message.window_seq, message.stride, list(message.steps)) == (5, 2, sent)
    assert {m.header.frame_id for m in (message, *message.poses)} == {"camera"}
    assert not any(pose.metric for pose in message.poses)
    assert c.stamp_from_ros(message.header.stamp) == window.stamp_ns[-1]
    assert {pose.stage for pose in message.poses} == {Pose3D.REFINED}
    for pose, joints in zip(message.poses, window.joints3d, strict=True):
        np.testing.assert_array_equal(c.pose3d_from_ros(pose).joints3d, joints.astype(np.float32))


def test_a_window_in_map_states_frame_scale_camera_and_the_newest_state():
    rotation = np.stack([matrix_from_quaternion(np.array([0.5, -0.5, 0.1 * i, 0.7])) for i in range(3)])
    window = replace(adjusted(Effort()), in_map=InMap(rotation, np.zeros((3, 3)), np.zeros(6)))
    # The newest image is later than the newest pose: the camera's pose there was not known yet.
    whole = given(np.arange(11) * 10**8)._replace(known_ns=(950_000_000, 960_000_000))
    message = c.window_to_ros(whole, window, "camera", 5, 0.25)
    assert c.stamp_from_ros(message.header.stamp) == 10**9
    assert c.stamp_from_ros(message.telemetry_stamp) == 950_000_000
    assert c.stamp_from_ros(message.background_stamp) == 960_000_000
    assert {m.header.frame_id for m in (message, *message.poses)} == {"map"}
    for pose, turn in zip(message.poses, rotation, strict=True):
        q = pose.camera_orientation
        assert pose.metric
        np.testing.assert_allclose(matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w])), turn, atol=1e-12)


def test_unknown_values_of_the_vehicle_stay_nan():
    message = c.vehicle_state_to_ros(VehicleState(stamp_ns=3))
    assert np.isnan(message.position_enu_m).all()
    assert np.isnan(message.battery_fraction)
    assert message.header.frame_id == "map"


def test_stamps_keep_every_nanosecond():
    for stamp in (0, 1, 999_999_999, 10**9, 1_700_000_000_123_456_789):
        assert c.stamp_from_ros(c.stamp_to_ros(stamp)) == stamp


def test_odometry_and_fix_say_what_the_vehicle_state_says():
    half = np.sqrt(0.5)
    state = VehicleState(
        stamp_ns=3_000_000_001,
        position_enu_m=np.array([1.0, 2.0, 3.0]),
        velocity_enu_m_s=np.array([0.0, 4.0, 1.0]),  # the vehicle looks north and flies on
        orientation_xyzw=np.array([0.0, 0.0, half, half]),
        angular_velocity_flu_rad_s=np.array([0.1, 0.2, 0.3]),
        latitude_deg=47.5,
        longitude_deg=8.5,
        gps_fix_type=3,
    )
    odometry = c.odometry_to_ros(state)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (3, 1)
    assert odometry.pose.pose.position.y == 2.0
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    np.testing.assert_allclose([linear.x, linear.y, linear.z], [4.0, 0.0, 1.0], atol=1e-12)
    assert angular.z == 0.3
    fix = c.fix_to_ros(state)
    assert (fix.latitude, fix.longitude, fix.status.status) == (47.5, 8.5, 0)
    assert np.isnan(fix.altitude)
    kinds = [c.fix_to_ros(replace(state, gps_fix_type=kind)).status.status for kind in range(9)]
    assert kinds == [-1, -1, -1, 0, 1, 2, 2, 2, 2]  # from the fifth on, corrected by a ground station


def test_what_is_not_known_is_nan_and_no_fix():
    state = VehicleState(stamp_ns=0)
    assert np.isnan(c.odometry_to_ros(state).twist.twist.linear.x)
    assert c.fix_to_ros(state).status.status == -1
