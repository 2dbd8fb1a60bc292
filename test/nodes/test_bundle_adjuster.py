"""Initializer and bundle adjuster in the running graph: in ``map``, in ``odom``, and with malformed poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bent_lenses import BENT, bent
from telemetry_stream import orbit

from drocap_ros.background import FixedPoints
from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.flight.vehicle import OPTICAL_FROM_FLU, VehicleState
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from drocap_ros.keypoints import PoseObservation
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.reconstruction.live.initializer import LivePose
from drocap_ros.recording.open_session import open_session
from drocap_ros.ros.conversions import (
    background_to_ros,
    camera_info_to_ros,
    header_at,
    pose2d_to_ros,
    pose3d_to_ros,
    stamp_from_ros,
    vehicle_state_to_ros,
)
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import NODES as GRAPH
from drocap_ros.ros.topics import TOPICS
from lab.simulation.capture import simulate_capture

NODES = ("initializer", "bundle_adjuster", "session_recorder")
LENS = "rational_polynomial"
S = 10**9
BEGIN = 1_790_000_000 * S


def observed(seconds, track_id=1, begin_ns=BEGIN, seed=0):
    tracks = simulate_capture(seconds, 20.0, seed=seed).tracks
    return [
        PoseObservation(
            begin_ns + int(stamp - tracks.stamp_ns[0]),
            track_id,
            tracks.image_size,
            keypoints=tracks.keypoints[i].astype(np.float32),
            covariance=tracks.covariance[i].astype(np.float32),
            confidence=tracks.confidence[i].astype(np.float32),
        )
        for i, stamp in enumerate(tracks.stamp_ns)
    ]


def fly(folder, flown, states_until_ns):
    """An orbit's topics through a recorded graph, its vehicle's states up to a time; gives what was published.

    The lens bends what it shows: poses and paths have to be as accurate as those of an ideal one.
    """
    config = DrocapConfig().replace("session_recorder", session_dir=str(folder))
    # A busy machine takes its time here, instead of every fourth image.
    config = config.replace("bundle_adjuster", max_solve_s=5.0)
    seen = {topic: [] for topic in ("pose3d/latest", "pose3d/refined", "/tf", "/diagnostics")}
    camera = CameraModel(*flown.observations[0].image_size, flown.matrix, np.array(BENT[LENS]), LENS)
    gimbal = quaternion_from_matrix(np.swapaxes(OPTICAL_FROM_FLU.T @ flown.rotation, 1, 2))
    with bringup(config, NODES) as graph:
        for topic, messages in seen.items():
            graph.node.create_subscription(TOPICS[topic].message, topic, messages.append, TOPICS[topic].qos)
        publish = {
            topic: graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
            for topic in ("pose2d", "vehicle/state", "camera_info", "background")
        }
        graph.wait_until(
            lambda: [p.get_subscription_count() for p in publish.values()] == [3, 2, 3, 2], 20, "the nodes to listen"
        )
        for i, observation in enumerate(flown.observations):
            stamp_ns = observation.stamp_ns
            if stamp_ns < states_until_ns:
                state = VehicleState(stamp_ns, position_enu_m=flown.position[i], gimbal_orientation_xyzw=gimbal[i])
                publish["vehicle/state"].publish(vehicle_state_to_ros(state))
            header, here = header_at(stamp_ns, "camera"), flown.background.frame == i
            point = bent(flown.background.point[here], flown.matrix, LENS).astype(np.float32)
            points = FixedPoints(flown.background.track[here], point)
            shown = bent(observation.keypoints, flown.matrix, LENS).astype(np.float32)
            publish["camera_info"].publish(camera_info_to_ros(header, camera))
            publish["background"].publish(background_to_ros(points, header))
            publish["pose2d"].publish(pose2d_to_ros(replace(observation, keypoints=shown), "camera"))
            graph.spin_for(0.066)
        last_ns = flown.observations[-1].stamp_ns
        graph.wait_until(
            lambda: any(stamp_from_ros(m.header.stamp) == last_ns for m in seen["pose3d/latest"]), 30, "the last pose"
        )
        reports = len(seen["/diagnostics"])
        graph.wait_until(lambda: len(seen["/diagnostics"]) > reports + 6, 20, "the counts on /diagnostics")
    texts = [s for m in seen["/diagnostics"] for s in m.status if s.name.endswith("bundle_adjuster")]
    return folder, flown, seen, texts


@pytest.fixture(scope="module")
def orbited(tmp_path_factory):
    """An orbit whose telemetry ends before its images."""
    return fly(tmp_path_factory.mktemp("orbit") / "session", orbit(14.0, begin_ns=BEGIN), BEGIN + 9.2 * S)


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """An orbit without a vehicle."""
    return fly(tmp_path_factory.mktemp("odom") / "session", orbit(8.0, begin_ns=BEGIN), 0)


def test_poses_with_telemetry_are_in_map_and_metric_until_it_stops(orbited):
    _, flown, seen, texts = orbited
    place = {int(stamp): i for i, stamp in enumerate(flown.stamp_ns)}
    frames = [window.header.frame_id for window in seen["pose3d/refined"]]
    assert frames[0] == frames[-1] == "camera"
    assert "map" in frames
    for window in seen["pose3d/refined"]:
        in_map = window.header.frame_id == "map"
        assert {(pose.header.frame_id, pose.metric) for pose in window.poses} == {(window.header.frame_id, in_map)}
        assert in_map == all(np.isfinite(pose.camera_orientation.w) for pose in window.poses)
    assert {m.header.frame_id for m in seen["pose3d/latest"]} == {"camera", "map"}
    placed = [m for m in seen["pose3d/latest"] if m.header.frame_id == "map"]
    off = [
        np.linalg.norm(np.reshape(m.joints, (-1, 3))[0] - flown.truth[place[stamp_from_ros(m.header.stamp)], 0])
        for m in placed
    ]
    assert np.median(off) < 0.4
    assert all(m.metric and np.isfinite(m.camera_orientation.w) for m in placed)
    # 0.1 s after the last state there is no camera pose to hold.
    assert max(stamp_from_ros(m.header.stamp) for m in placed) < BEGIN + 9.4 * S
    used = [{v.key: v.value for v in status.values} for status in texts]
    assert {"used", "late"} <= {values.get(Key.TELEMETRY) for values in used}
    assert any("yaw" in values.get(Key.CALIBRATION, "") for values in used)
    assert any(window.background_stamp.sec for window in seen["pose3d/refined"])
    assert used[-1][Key.FRAME] == "camera"
    assert texts[-1].level == b"\1"
    assert "no reported camera pose" in texts[-1].message


def test_the_recording_of_windows_in_map_repeats_them_bit_for_bit(orbited):
    folder = orbited[0]
    with open_session(folder) as session:
        motion, _, agreement = reconstruct_live(session, recorded_config(session))
        assert session.warnings == []
    windows = len(orbited[2]["pose3d/refined"])
    assert agreement.initial == [210, 210]
    assert agreement.windows[0] >= windows >= 5
    assert agreement.windows[0] == agreement.windows[1]
    # The windows after the end of the telemetry hold older images too, whose poses stay in the world.
    placed = {stamp_from_ros(p.header.stamp) for w in orbited[2]["pose3d/refined"] for p in w.poses if p.metric}
    if 2 * len(placed) >= agreement.initial[0]:
        assert (motion.frame, motion.metric) == ("world", True)
        assert set(motion.stamp_ns.tolist()) == placed
    else:
        assert (motion.frame, len(motion.stamp_ns)) == ("camera", 210)


def test_windows_without_telemetry_are_in_odom_with_their_camera_on_tf(walked):
    _, true, seen, texts = walked
    there = [w for w in seen["pose3d/refined"] if w.header.frame_id == "odom"]
    assert there
    for window in there:
        assert {(p.header.frame_id, p.metric) for p in window.poses} == {("odom", False)}
        assert all(np.isfinite(p.camera_orientation.w) for p in window.poses)
        joints = np.reshape(window.poses[-1].joints, (-1, 3))
        assert joints[8, 2] > joints[0, 2]  # the head above the pelvis
    transforms = [t for m in seen["/tf"] for t in m.transforms if t.header.frame_id == "odom"]
    assert [stamp_from_ros(t.header.stamp) for t in transforms] == [stamp_from_ros(w.header.stamp) for w in there]
    assert {t.child_frame_id for t in transforms} == {"camera"}
    up = [matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w]))[2] for q in (t.transform.rotation for t in transforms)]
    place = np.searchsorted(true.stamp_ns, [stamp_from_ros(t.header.stamp) for t in transforms])
    assert np.degrees(np.arccos(np.sum(up * true.rotation[place][..., 2], axis=1))).max() < 4.0
    # The newest pose is on its former path.
    assert {m.header.frame_id for m in seen["pose3d/latest"]} == {"camera"}
    told = [{v.key: v.value for v in status.values} for status in texts]
    assert any("path 1, a camera that moves; up to" in values.get(Key.PICTURE_PATH, "") for values in told)
    assert told[-1][Key.TELEMETRY] == "none"


def test_the_recording_of_windows_in_odom_repeats_them_bit_for_bit(walked):
    folder, true, seen, _ = walked
    with open_session(folder) as session:
        motion, _, agreement = reconstruct_live(session, recorded_config(session))
        assert session.warnings == []
    assert agreement.windows[0] == agreement.windows[1] >= len(seen["pose3d/refined"])
    if motion.frame == "world":
        assert (motion.metric, motion.scale_source) == (False, "assumed_height")
    assert len(motion.joints3d) <= len(true.stamp_ns)


def test_the_bridge_hears_no_3d_pose_and_no_transform():
    assert set(GRAPH["mavlink_bridge"].subscribes) == {"pose2d", "camera_info", "orbit/status"}


def initial_pose(observation, track_id, joints, skeleton=None):
    """An initial pose of 0, 15 or 17 joints."""
    values = np.random.default_rng(joints).normal(size=(joints, 3)), np.zeros((joints, 6)), np.ones(joints)
    message = pose3d_to_ros(LivePose(observation.stamp_ns, track_id, *values, 1.0), "camera")
    message.skeleton = skeleton or message.skeleton
    return message


def test_initial_poses_of_another_subject_and_of_other_joints_do_not_end_the_node():
    config = DrocapConfig().replace("bundle_adjuster", period_s=0.3, window_s=4.0, max_solve_s=5.0)
    latest, reports, windows = [], [], []
    with bringup(config, ["bundle_adjuster"]) as graph:
        publishers = {}
        for topic in ("pose2d", "pose3d/initial"):
            publishers[topic] = graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
        for topic, into in (("pose3d/latest", latest), ("pose3d/refined", windows), ("/diagnostics", reports)):
            graph.node.create_subscription(TOPICS[topic].message, topic, into.append, TOPICS[topic].qos)
        graph.wait_until(lambda: all(p.get_subscription_count() for p in publishers.values()), 20, "the node to listen")

        def publish(observation, *pose):
            publishers["pose2d"].publish(pose2d_to_ros(observation, "camera"))
            publishers["pose3d/initial"].publish(initial_pose(observation, *pose))
            graph.spin_for(0.12)  # raises the error of the node

        # Windows of fifteen and of seventeen joints in turn: a gap empties the window.
        taken = [o for burst in range(4) for o in observed(1.0, begin_ns=BEGIN + 3 * S * burst)[::2]]
        for i, observation in enumerate(taken):
            publish(observation, 1, (15, 17)[i // 10 % 2])
            if i % 10 == 9:
                graph.wait_until(lambda burst=i // 10: len(windows) > burst, 30, "a window of these joints")
        for observation, pose in zip(
            observed(0.3, begin_ns=BEGIN + 14 * S), [(1, 17, "coco17"), (0, 0), (2, 15)], strict=False
        ):
            publish(observation, *pose)
        graph.wait_until(lambda: len(latest) == len(taken), 10, "the latest poses")
        count = len(reports)
        graph.wait_until(lambda: len(reports) > count + 1, 10, "the counts on /diagnostics")
    values = {v.key: v.value for v in reports[-1].status[0].values}
    assert int(values[Key.ADJUSTMENTS]) >= 4
    assert values[Key.MESSAGES_REFUSED] == "3"
    assert "track_id: expected 1 in pose3d/initial" in values[Key.LAST_REFUSED]
