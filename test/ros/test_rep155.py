"""The subject by REP 155, from the visualizer on a running graph."""

import contextlib
import time

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header, String
from visualization_msgs.msg import MarkerArray

from drocap_ros.bringup import free_domain
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.keypoints import PoseObservation
from drocap_ros.msg import Pose2D, Pose3D
from drocap_ros.nodes import visualizer
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.ros import markers
from drocap_ros.ros.conversions import header_at, pose2d_to_ros, pose3d_to_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import KEPT_QOS, RESULT_QOS, TFMessage
from drocap_ros.skeleton import BODY_15
from drocap_ros.view.visualizer_config import VisualizerConfig
from lab.simulation.capture import simulate_capture

hri = pytest.importorskip("hri_msgs.msg", reason="no hri_msgs here: `make setup` builds it")


@pytest.fixture(scope="module")
def capture():
    return simulate_capture(0.2, 10.0, seed=1)


def pose3d(joints, track_id=7):
    return pose3d_to_ros(LivePose(5, track_id, joints, np.zeros((15, 6)), np.ones(15), 1.0), "map")


def observation(keypoints, track_id=7, size=(640, 480)):
    seen = track_id > 0
    return PoseObservation(
        5,
        track_id,
        size,
        roi=np.array([64.0, 48.0, 320.0, 960.0]),
        detection_score=0.9,
        keypoints=keypoints if seen else keypoints[:0],
        covariance=np.ones((15 if seen else 0, 3)),
        confidence=np.full(15 if seen else 0, 0.8),
    )


def vector(v):
    return np.array([v.x, v.y, v.z])


def turn(q):
    return matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w]))


def test_frames_place_every_joint_at_its_position(capture):
    joints = capture.joints3d_world[0]
    body, *links = markers.human_transforms(pose3d(joints))
    assert (body.header.frame_id, body.child_frame_id) == ("map", "body_b7")
    place, axes = vector(body.transform.translation), turn(body.transform.rotation)
    np.testing.assert_allclose(place, joints[[BODY_15.index("lhip"), BODY_15.index("rhip")]].mean(0), atol=1e-5)
    found = {}
    for link in links:
        assert link.header.frame_id == "body_b7"
        found[link.child_frame_id] = place + axes @ vector(link.transform.translation)
    assert set(found) == {f"{link}_b7" for link in markers.LINKS.values()}
    np.testing.assert_allclose(found["l_knee_b7"], joints[BODY_15.index("lknee")], atol=1e-5)
    np.testing.assert_allclose(found["head_b7"], joints[BODY_15.index("head")], atol=1e-5)
    # x forward, z towards the head: the left hip lies to the left.
    assert (axes.T @ (joints[BODY_15.index("head")] - place))[2] > 0.5
    assert (axes.T @ (joints[BODY_15.index("lhip")] - place))[1] > 0.05


def test_without_a_trunk_there_is_no_body_frame(capture):
    joints = capture.joints3d_world[0].copy()
    joints[BODY_15.index("neck")] = np.nan
    assert markers.human_transforms(pose3d(joints)) == []
    assert markers.human_transforms(Pose3D(skeleton="body15")) == []


def test_keypoints_are_relative_to_the_image_and_none_lies_outside(capture):
    points = np.tile([320.0, 120.0], (15, 1))
    points[BODY_15.index("rwrist")] = (700.0, 100.0)
    points[BODY_15.index("lknee")] = np.nan
    skeleton = markers.skeleton2d(observation(points), Header()).skeleton
    elbow = skeleton[hri.Skeleton2D.RIGHT_ELBOW]
    assert (elbow.x, elbow.y, elbow.c) == pytest.approx((0.5, 0.25, 0.8))
    for code in (hri.Skeleton2D.RIGHT_WRIST, hri.Skeleton2D.LEFT_KNEE, hri.Skeleton2D.NOSE):
        assert skeleton[code].c == 0.0
    box = markers.region(observation(points), Header())
    assert (box.xmin, box.ymin, box.xmax, box.ymax) == pytest.approx((0.1, 0.1, 0.5, 1.0))


@contextlib.contextmanager
def graph(namespace="/drocap", **parameters):
    """The visualizer, a node beside it, and a function that serves both until a condition holds."""
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        executor = SingleThreadedExecutor(context=context)
        place = {"context": context, "namespace": namespace, "use_global_arguments": False}
        node = visualizer.VisualizerNode(VisualizerConfig(**parameters), **place)
        other = Node("other", **place)
        for each in (node, other):
            executor.add_node(each)

        def until(condition):
            end = time.monotonic() + 20
            while not condition():
                assert time.monotonic() < end, "it did not come"
                executor.spin_once(timeout_sec=0.05)

        try:
            yield node, other, until
        finally:
            for each in (node, other):
                each.destroy_node()
            executor.shutdown()
            context.try_shutdown()


@pytest.mark.parametrize(
    ("prefix", "namespace", "name"),
    [("", "/drocap", "b7"), ("drone2/", "/drocap", "drone2_b7"), ("", "/drone_1", "drone_1_b7")],
)
def test_tracked_body_is_published_while_it_is_tracked(capture, prefix, namespace, name):
    points = np.tile([320.0, 120.0], (15, 1))
    with graph(namespace, human_topics=True, frame_prefix=prefix) as (node, other, until):
        ids, skeletons, boxes, frames = [], [], [], []
        qos = QoSProfile(depth=10)
        other.create_subscription(hri.IdsList, "/humans/bodies/tracked", lambda m: ids.append(list(m.ids)), qos)
        other.create_subscription(hri.Skeleton2D, f"/humans/bodies/{name}/skeleton2d", skeletons.append, qos)
        other.create_subscription(hri.NormalizedRegionOfInterest2D, f"/humans/bodies/{name}/roi", boxes.append, qos)
        other.create_subscription(
            TFMessage, "/tf", lambda m: frames.extend(t.child_frame_id for t in m.transforms), RESULT_QOS
        )
        keypoints = other.create_publisher(Pose2D, "pose2d", RESULT_QOS)
        poses = other.create_publisher(Pose3D, "pose3d/initial", RESULT_QOS)
        until(lambda: keypoints.get_subscription_count() and poses.get_subscription_count())
        seen = pose2d_to_ros(observation(points), "camera_optical")
        stamp = time.monotonic()

        def arrived():
            # The body's own topics are new: discovery takes a while, and a tracked body is seen in image after image.
            nonlocal stamp
            if time.monotonic() - stamp > 0.2:
                stamp = time.monotonic()
                keypoints.publish(seen)
                poses.publish(pose3d(capture.joints3d_world[0]))
            return ids and skeletons and boxes and frames

        until(arrived)
        assert ids[-1] == [name]
        assert skeletons[-1].header == seen.header
        assert {f"body_{name}", f"l_wrist_{name}", f"{prefix}body_7/lwrist"} <= set(frames)

        keypoints.publish(pose2d_to_ros(observation(points, track_id=0), "camera_optical"))
        until(lambda: ids[-1] == [])
        until(lambda: not node.get_publishers_info_by_topic(f"/humans/bodies/{name}/skeleton2d"))


def test_a_person_has_an_identifier_that_late_subscribers_hear_until_the_track_ends():
    points = np.tile([320.0, 120.0], (15, 1))
    with graph(human_topics=True) as (node, other, until):
        persons, owners = [], []
        other.create_subscription(hri.IdsList, "/humans/persons/tracked", lambda m: persons.append(list(m.ids)), 10)
        other.create_subscription(String, "/humans/persons/p7/body_id", lambda m: owners.append(m.data), KEPT_QOS)
        publisher = other.create_publisher(Pose2D, "pose2d", RESULT_QOS)
        until(lambda: publisher.get_subscription_count() and node.count_subscribers("/humans/persons/tracked"))
        publisher.publish(pose2d_to_ros(observation(points, track_id=7), "camera_optical"))
        until(lambda: persons and persons[-1] == ["p7"] and owners == ["b7"])
        publisher.publish(pose2d_to_ros(observation(points, track_id=8), "camera_optical"))
        until(lambda: persons[-1] == ["p8"])
        until(lambda: not node.get_publishers_info_by_topic("/humans/bodies/b7/roi"))


def test_without_hri_msgs_the_frames_remain_and_the_status_names_the_reason(capture, monkeypatch):
    monkeypatch.setattr(visualizer, "AVAILABLE", False)
    with graph(human_topics=True) as (node, other, until):
        frames = []
        other.create_subscription(TFMessage, "/tf", lambda m: frames.extend(m.transforms), RESULT_QOS)
        poses = other.create_publisher(Pose3D, "pose3d/initial", RESULT_QOS)
        until(lambda: poses.get_subscription_count() and node.count_subscribers("/tf"))
        poses.publish(pose3d(capture.joints3d_world[0]))
        until(lambda: frames)
        assert "body_b7" in {t.child_frame_id for t in frames}
        assert node._text.endswith(markers.MISSING)
        assert not node.get_publishers_info_by_topic("/humans/bodies/tracked")


def test_markers_have_their_rate_and_every_pose_its_frames(capture):
    with graph(marker_rate_hz=10.0) as (node, other, until):
        arrays, frames = [], []
        other.create_subscription(MarkerArray, "markers/initial", arrays.append, RESULT_QOS)
        other.create_subscription(TFMessage, "/tf", frames.append, RESULT_QOS)
        poses = other.create_publisher(Pose3D, "pose3d/initial", RESULT_QOS)
        until(
            lambda: (
                poses.get_subscription_count()
                and node.count_subscribers("/tf")
                and node.count_subscribers("/drocap/markers/initial")
            )
        )
        for i in range(30):
            message = pose3d(capture.joints3d_world[0])
            message.header = header_at(10**12 + round(i * 1e9 / 30), "map")
            poses.publish(message)  # all at once, those that wait are passed over
            until(lambda: len(frames) == i + 1)  # noqa: B023
        until(lambda: len(arrays) == 10)
        broken = pose3d(capture.joints3d_world[0])
        broken.header = header_at(10**12 + round(29 * 1e9 / 30), "map")
        broken.joints = broken.joints[:7]
        poses.publish(broken)
        until(lambda: node.counters[Key.MESSAGES_REFUSED] == 1)
        assert len(arrays) == 10
