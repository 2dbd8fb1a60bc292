"""A real video through the live graph: all six nodes in processes of their own, the recorder on."""

import shutil

import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from drocap_ros.bringup import bringup
from drocap_ros.cli import main
from drocap_ros.config import DrocapConfig
from drocap_ros.motion import load_motion
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import TOPICS
from drocap_ros.simulation.vehicle.loopback import free_udp_port

NODES = ["image_ingest", "pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "session_recorder"]


def test_published_messages_are_recorded_and_reconstructed(shared, tmp_path):
    video = tmp_path / "walk.mp4"
    shutil.copyfile(shared / "media" / "outdoor_walk.mp4", video)
    # In a loop: a busy machine processes fewer of its images, and the test needs a number of them.
    config = DrocapConfig().replace("image_ingest", source=str(video), horizontal_fov_deg=60.0, loop=True)
    config = config.replace("pose_estimator", models_dir=str(shared / "models"))
    config = config.replace("mavlink_bridge", url=f"udpin:127.0.0.1:{free_udp_port()}")
    config = config.replace("session_recorder", session_dir=str(tmp_path / "session"))
    heard, refined = [], []
    with bringup(config, NODES, processes=True) as graph:
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", heard.append, TOPICS["pose2d"].qos)
        graph.node.create_subscription(TOPICS["pose3d/refined"].message, "pose3d/refined", refined.append, 10)
        graph.wait_until(lambda: len(heard) > 80 and refined, 200, "keypoints and an adjustment")

    # The standard readers decode every message, and every message received here is recorded.
    (path,) = (tmp_path / "session").glob("*.mcap")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    recorded, published = {}, 0
    with AnyReader([tmp_path / "session"]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == "/drocap/pose2d":
                recorded[stamp_from_ros(message.header.stamp)] = message
            elif connection.topic == "/diagnostics" and message.status[0].name.endswith("pose_estimator"):
                published = max(published, *(int(v.value) for v in message.status[0].values if v.key == Key.IMAGES), 0)
    assert len(recorded) >= published > 20  # the count of the estimator in its last status
    assert counts["/drocap/pose2d"] == len(recorded) >= len(heard)
    for message in heard:
        np.testing.assert_array_equal(recorded[stamp_from_ros(message.header.stamp)].keypoints, message.keypoints)
    for topic in ("image/compressed", "camera_info", "pose3d/initial", "pose3d/refined", "pose3d/latest"):
        assert counts[f"/drocap/{topic}"] > 0, topic
    assert counts["/drocap/orbit/status"] > 0
    assert counts["/diagnostics"] > 0

    # Offline, the session gives the keypoints that were published live.
    assert (
        main(["reconstruct", str(tmp_path / "session"), "--out", str(tmp_path / "out"), "--no-report", "--quiet"]) == 0
    )
    motion = load_motion(tmp_path / "out" / "motion.npz")
    live = {stamp: m for stamp, m in recorded.items() if m.track_id}
    offline = {int(s): k for s, k in zip(motion.stamp_ns, motion.keypoints, strict=True) if np.isfinite(k).any()}
    assert set(offline) == {stamp for stamp, m in live.items() if np.isfinite(m.keypoints).any()}
    for stamp, keypoints in offline.items():
        sent = live[stamp].keypoints.reshape(-1, 2).astype(np.float64)
        np.testing.assert_array_equal(keypoints[: len(sent)], sent)
        assert np.isnan(keypoints[len(sent) :]).all()  # toes, which this network does not see
