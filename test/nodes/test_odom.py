"""The running graph without any telemetry: windows in ``odom``, its TF, and a recording that repeats them."""

from __future__ import annotations

import numpy as np
import pytest
from telemetry_stream import orbit

from drocap_ros.background import FixedPoints
from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.geometry.rotations import matrix_from_quaternion
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.perception.calibration import CameraModel
from drocap_ros.recording.open_session import open_session
from drocap_ros.ros.conversions import (
    background_to_ros,
    camera_info_to_ros,
    header_at,
    pose2d_to_ros,
    stamp_from_ros,
)
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import NODES, TOPICS

S = 10**9
BEGIN = 1_790_000_000 * S
GRAPH = ("initializer", "bundle_adjuster", "session_recorder")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """A clip's topics, and no vehicle: the session, the orbit and the messages."""
    folder, true = tmp_path_factory.mktemp("odom") / "session", orbit(8.0, begin_ns=BEGIN)
    config = DrocapConfig().replace("session_recorder", session_dir=str(folder))
    config = config.replace("bundle_adjuster", max_solve_s=5.0)  # a busy machine takes its time
    seen = {topic: [] for topic in ("pose3d/latest", "pose3d/refined", "/tf", "/diagnostics")}
    camera = CameraModel(*true.observations[0].image_size, true.matrix)
    with bringup(config, GRAPH) as graph:
        for topic, messages in seen.items():
            graph.node.create_subscription(TOPICS[topic].message, topic, messages.append, TOPICS[topic].qos)
        to = {
            topic: graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
            for topic in ("pose2d", "camera_info", "background")
        }
        graph.wait_until(
            lambda: [p.get_subscription_count() for p in to.values()] == [3, 2, 2], 20, "the nodes to listen"
        )
        for i, observation in enumerate(true.observations):
            header = header_at(observation.stamp_ns, "camera")
            here = true.background.frame == i
            points = FixedPoints(true.background.track[here], true.background.point[here])
            to["camera_info"].publish(camera_info_to_ros(header, camera))
            to["background"].publish(background_to_ros(points, header))
            to["pose2d"].publish(pose2d_to_ros(observation, "camera"))
            graph.spin_for(0.066)
            graph.wait_until(lambda now=i: len(seen["pose3d/latest"]) > now, 30, "the latest pose")
        graph.wait_until(
            lambda: any(w.header.frame_id == "odom" for w in seen["pose3d/refined"]), 120, "a window in odom"
        )
        reports = len(seen["/diagnostics"])
        graph.wait_until(lambda: len(seen["/diagnostics"]) > reports + 6, 20, "the words on /diagnostics")
    return folder, true, seen


def test_windows_without_telemetry_are_in_odom_with_their_camera_on_tf(walked):
    _, true, seen = walked
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
    told = [
        {v.key: v.value for v in status.values}
        for m in seen["/diagnostics"]
        for status in m.status
        if status.name.endswith("bundle_adjuster")
    ]
    assert any("path 1, a camera that moves; up to" in values.get(Key.PICTURE_PATH, "") for values in told)
    assert told[-1][Key.TELEMETRY] == "none"


def test_the_recording_of_windows_in_odom_repeats_them_bit_for_bit(walked):
    folder, true, seen = walked
    with open_session(folder) as session:
        motion, _, agreement = reconstruct_live(session, recorded_config(session))
        assert session.warnings == []
    assert agreement.windows[0] == agreement.windows[1] >= len(seen["pose3d/refined"])
    if motion.frame == "world":
        assert (motion.metric, motion.scale_source) == (False, "assumed_height")
    assert len(motion.joints3d) <= len(true.stamp_ns)


def test_the_bridge_hears_no_3d_pose_and_no_transform():
    assert set(NODES["mavlink_bridge"].subscribes) == {"pose2d", "camera_info", "orbit/status"}
