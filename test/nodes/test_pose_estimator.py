"""The pose estimator's node with the networks for simulation."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.nodes.pose_estimator import PoseEstimatorNode
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session import header_stamp_ns
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.diagnostics import Key, node_of, of, values_of
from drocap_ros.ros.topics import TOPICS

MISSED = of(Key.MISSED, "image/compressed")


def test_networks_for_simulation_are_named_on_diagnostics():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = PoseEstimatorNode(
            PoseEstimatorConfig(models_dir="simulation"), context=context, use_global_arguments=False
        )
        try:
            assert "for simulation only" in node.details[Key.NETWORKS]
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()


@pytest.mark.parametrize(("max_load_level", "sheds"), [(3, True), (0, False)])
def test_estimator_sheds_load_while_images_queue_unless_configured_otherwise(tmp_path, max_load_level, sheds):
    for i in range(8):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), np.full((90, 120, 3), 20 * i, np.uint8))
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path), loop=True, folder_rate_hz=240.0)
    config = config.replace("pose_estimator", models_dir="simulation", max_load_level=max_load_level)
    values = {}

    def take(message):
        values.update({node_of(status)[1]: values_of(status) for status in message.status})

    def count(key):
        return int(values.get("pose_estimator", {}).get(key, 0))

    with bringup(config, ["image_ingest", "pose_estimator"], processes=True) as graph:
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", take, TOPICS["/diagnostics"].qos)
        graph.wait_until(lambda: count(MISSED) > 0 and count(Key.IMAGES) > 20, 30, "more images than it can process")
        graph.spin_for(2.0)
        assert (count(Key.IMAGES_SHED) > 0) is sheds


def test_fixed_points_of_the_scene_are_published_and_recorded(tmp_path):
    """A camera pans over a wall: the points move by as much, and the session gives them back bit for bit."""
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.normal(120, 30, (40, 90)).clip(0, 255).astype(np.uint8), (900, 400))
    for i in range(10):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), wall[20:380, 10 + 7 * i : 650 + 7 * i])
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path / "images"), folder_rate_hz=5.0, loop=True)
    # The network sees persons in the pattern, and no point lies on a person.
    config = config.replace("pose_estimator", models_dir="simulation", max_load_level=0, detection_threshold=1.0)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "s"))
    heard = []
    with bringup(config, ["image_ingest", "pose_estimator", "session_recorder"]) as graph:
        entry = TOPICS["background"]
        graph.node.create_subscription(entry.message, "background", heard.append, entry.qos)
        graph.wait_until(lambda: len(heard) >= 10, 60, "ten images")
    seen = {"background": {}, "pose2d": {}}
    with open_session(tmp_path / "s") as session:
        for raw, message in session.messages([f"/drocap/{topic}" for topic in seen]):
            seen[raw.topic.split("/")[-1]][header_stamp_ns(message)] = message
        tracks = read_pose2d(session)
    assert len(seen["background"]) >= 10
    steps = []
    for (_, last), (stamp_ns, now) in pairwise(sorted(seen["background"].items())):
        assert now.header.frame_id == seen["pose2d"][stamp_ns].header.frame_id == "camera_optical"
        assert 40 < len(now.track) == len(now.point) / 2
        _, i, j = np.intersect1d(last.track, now.track, return_indices=True)
        points = [np.reshape(message.point, (-1, 2))[k] for message, k in ((last, i), (now, j))]
        steps.append(np.median(points[1] - points[0], axis=0))
    # A busy machine may miss images, and after the last one the pan begins anew.
    assert np.abs(np.round(np.array(steps) / 7) * 7 - steps).max() < 0.3
    assert np.median(steps, axis=0) == pytest.approx([-7, 0], abs=0.3)
    frames = dict(zip(tracks.stamp_ns.tolist(), range(len(tracks)), strict=True))
    for stamp_ns, message in seen["background"].items():
        rows = tracks.background.frame == frames[stamp_ns]
        assert tracks.background.track[rows].tolist() == list(message.track)
        assert tracks.background.point[rows].ravel().tolist() == list(message.point)
