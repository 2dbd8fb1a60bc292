"""A node that has nothing to do names the reason on /diagnostics."""

import numpy as np
import pytest

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.keypoints import PoseObservation
from drocap_ros.ros.conversions import pose2d_to_ros
from drocap_ros.ros.diagnostics import node_of
from drocap_ros.ros.topics import RESULT_QOS, TOPICS
from drocap_ros.simulation.vehicle.loopback import free_udp_port
from lab.simulation.capture import simulate_capture

NODES = ["pose_estimator", "initializer", "bundle_adjuster", "mavlink_bridge", "visualizer", "session_recorder"]
SILENT = {
    "pose_estimator": "idle: no message on image/compressed since the start: nobody publishes it",
    "initializer": "idle: no message on pose2d since the start",
    "bundle_adjuster": "idle: no message on pose2d since the start",
    "visualizer": "idle: no message on pose2d since the start",
    "mavlink_bridge": "no autopilot on udpin:127.0.0.1:",
    "session_recorder": "; no image and no pose has arrived yet",
}


@pytest.fixture
def graph(tmp_path):
    config = (
        DrocapConfig()
        .replace("pose_estimator", models_dir="simulation")
        .replace("mavlink_bridge", url=f"udpin:127.0.0.1:{free_udp_port()}")
        .replace("session_recorder", session_dir=str(tmp_path / "session"))
    )
    with bringup(config, NODES) as graph:
        graph.texts = {}

        def take(message):
            for status in message.status:
                graph.texts[node_of(status)[1]] = status.message

        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", take, RESULT_QOS)
        yield graph


def observation(graph, subject):
    stamp_ns = graph.node.get_clock().now().nanoseconds
    if not subject:
        return pose2d_to_ros(PoseObservation(stamp_ns, 0, (1280, 720)), "camera")
    tracks = simulate_capture(0.2, 10.0, seed=0).tracks
    seen = PoseObservation(
        stamp_ns, 1, tracks.image_size, keypoints=tracks.keypoints[0].astype(np.float32),
        covariance=tracks.covariance[0].astype(np.float32), confidence=tracks.confidence[0].astype(np.float32),
    )  # fmt: skip
    return pose2d_to_ros(seen, "camera")


def test_every_idle_node_names_its_reason(graph):
    def every_reason():
        return all(words in graph.texts.get(name, "") for name, words in SILENT.items())

    graph.wait_until(every_reason, 30, f"{SILENT}")
    publisher = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", RESULT_QOS)

    def publish_until(subject, expected):
        def done():
            publisher.publish(observation(graph, subject))
            return all(words in graph.texts[name] for name, words in expected.items())

        graph.wait_until(done, 20, f"{expected}, found {graph.texts}")

    publish_until(False, {"initializer": "no subject in view", "bundle_adjuster": "idle: no subject in view"})
    graph.wait_until(lambda: "no image" not in graph.texts["session_recorder"], 10, "the recorder to count")
    # One pose, then silence.
    publisher.publish(observation(graph, True))
    graph.wait_until(
        lambda: graph.texts["bundle_adjuster"] == "idle: too few poses for a first adjustment, 1 so far",
        20, f"too few poses, found {graph.texts}",
    )  # fmt: skip
    graph.wait_until(
        lambda: "no message on pose2d for" in graph.texts["initializer"], 20, f"silence, found {graph.texts}"
    )
