import math

import numpy as np
from visualization_msgs.msg import ImageMarker, Marker

from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import Pose3D
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.ros.conversions import header_at, pose2d_to_ros, pose3d_to_ros
from drocap_ros.ros.markers import body_transforms, keypoint_marker, path_marker, pose_markers
from drocap_ros.skeleton import BODY_15


def pose(unknown=()):
    rng = np.random.default_rng(0)
    joints = rng.normal(size=(15, 3))
    joints[list(unknown)] = np.nan
    root = 0.1 * rng.normal(size=(15, 3, 3))
    full = root @ np.swapaxes(root, 1, 2)
    packed = full.reshape(15, 9)[:, [0, 1, 2, 4, 5, 8]]
    message = pose3d_to_ros(LivePose(5, 4, joints, packed, np.ones(15), 1.0), "camera_optical")
    return message, joints, full


def by_namespace(array, namespace):
    return [marker for marker in array.markers if marker.ns == namespace]


def test_every_bone_and_joint_is_drawn_at_its_position():
    message, joints, _ = pose()
    markers = pose_markers(message, 0.5)
    (lines,), (balls,) = by_namespace(markers, "skeleton"), by_namespace(markers, "joints")
    assert lines.type == Marker.LINE_LIST
    drawn = np.array([(p.x, p.y, p.z) for p in lines.points]).reshape(-1, 2, 3)
    np.testing.assert_allclose(drawn, joints[BODY_15.bones], rtol=1e-6)
    np.testing.assert_allclose([(p.x, p.y, p.z) for p in balls.points], joints, rtol=1e-6)
    assert len(balls.colors) == 15
    assert lines.header.frame_id == "camera_optical"
    assert (lines.lifetime.sec, lines.lifetime.nanosec) == (0, 500_000_000)


def test_ellipsoids_have_the_covariance_of_the_pose():
    message, _, full = pose()
    balls = by_namespace(pose_markers(message, 0.5), "uncertainty")
    assert [ball.id for ball in balls] == list(range(15))
    for ball, wanted in zip(balls, full, strict=True):
        assert 0 < ball.color.a < 1  # the joint inside is seen
        o = ball.pose.orientation
        axes = matrix_from_quaternion(np.array([o.x, o.y, o.z, o.w]))
        sigma = np.array([ball.scale.x, ball.scale.y, ball.scale.z]) / 4.0
        np.testing.assert_allclose(axes @ np.diag(sigma**2) @ axes.T, wanted, atol=1e-4)


def test_unknown_joints_and_their_bones_are_left_out():
    knee = BODY_15.index("rknee")
    message, _, _ = pose(unknown=[knee])
    markers = pose_markers(message, 0.5)
    assert len(by_namespace(markers, "joints")[0].points) == 14
    assert len(by_namespace(markers, "skeleton")[0].points) == 2 * (14 - 2)
    assert knee not in [ball.id for ball in by_namespace(markers, "uncertainty")]
    names = [t.child_frame_id for t in body_transforms(message)]
    assert "body_4/rknee" not in names
    assert len(names) == 14


def test_without_a_subject_there_is_no_marker():
    assert pose_markers(Pose3D(skeleton="body15"), 0.5).markers == []
    assert body_transforms(Pose3D(skeleton="body15")) == []


def test_path_keeps_its_points_and_has_no_lifetime():
    line = path_marker(header_at(1, "map"), np.arange(12.0).reshape(4, 3))
    assert line.type == Marker.LINE_STRIP
    assert [p.z for p in line.points] == [2.0, 5.0, 8.0, 11.0]
    assert (line.lifetime.sec, line.lifetime.nanosec) == (0, 0)


def keypoints(track_id=4, unknown=()):
    points = np.random.default_rng(1).uniform(50, 400, (15, 2))
    points[list(unknown)] = np.nan
    seen = track_id > 0
    observation = PoseObservation(
        7,
        track_id,
        (640, 480),
        roi=np.array([40.0, 40.0, 410.0, 410.0]),
        detection_score=0.9,
        keypoints=points if seen else points[:0],
        covariance=np.ones((15 if seen else 0, 3)),
        confidence=np.ones(15 if seen else 0),
    )
    return pose2d_to_ros(observation, "camera_optical"), points


def test_keypoints_of_an_image_are_one_marker():
    knee = BODY_15.index("rknee")
    message, points = keypoints(unknown=[knee])
    marker = keypoint_marker(message)
    assert (marker.type, marker.action) == (ImageMarker.LINE_LIST, ImageMarker.ADD)
    assert marker.header == message.header
    drawn = np.array([(p.x, p.y) for p in marker.points]).reshape(-1, 2, 2)
    bones = [bone for bone in BODY_15.bones if knee not in bone]
    np.testing.assert_allclose(drawn[: len(bones)], points[bones], rtol=1e-6)
    # Two arms of a cross on each joint that is known, its middle the joint.
    crosses = drawn[len(bones) :].mean(1).reshape(-1, 2, 2)
    np.testing.assert_allclose(crosses[:, 0], np.delete(points, knee, 0), rtol=1e-6)
    np.testing.assert_allclose(crosses[:, 0], crosses[:, 1], rtol=1e-6)
    assert len(marker.outline_colors) == len(marker.points)


def test_without_a_subject_the_keypoints_are_removed():
    marker = keypoint_marker(keypoints(track_id=0)[0])
    assert marker.action == ImageMarker.REMOVE
    assert not marker.points


def test_prefix_distinguishes_the_frames_of_two_drones():
    message, _, _ = pose()
    assert {t.child_frame_id.split("/")[0] for t in body_transforms(message, "drone2/")} == {"drone2"}


def test_an_unknown_covariance_draws_no_ellipsoid_of_unknown_axes():
    message, _, _ = pose()
    message.covariance[6 * 3] = math.nan
    message.covariance[6 * 5 + 4] = math.nan
    balls = by_namespace(pose_markers(message, 0.5), "uncertainty")
    assert [ball.id for ball in balls] == [i for i in range(15) if i not in (3, 5)]
    assert all(math.isfinite(v) for ball in balls for v in (ball.scale.x, ball.scale.y, ball.scale.z))
