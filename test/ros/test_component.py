"""What every node shares, on live nodes."""

import contextlib
import time
from array import array

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import ParameterError
from drocap_ros.nodes.initializer import InitializerNode
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.reconstruction_config import InitializerConfig
from drocap_ros.ros.conversions import pose2d_to_ros
from drocap_ros.ros.topics import RESULT_QOS, TOPICS
from drocap_ros.simulation.capture import simulate_capture


@pytest.fixture
def context():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        yield context
        context.try_shutdown()


@contextlib.contextmanager
def initializer(context, config=None, **overrides):
    parameters = [Parameter(name, value=value) for name, value in overrides.items()]
    node = InitializerNode(config, context=context, use_global_arguments=False, parameter_overrides=parameters)
    try:
        yield node
    finally:
        node.close()
        node.destroy_node()


def test_parameters_are_declared_from_the_dataclass_with_range_and_description(context):
    with initializer(context, InitializerConfig(azimuth_starts=5)) as node:
        assert node.get_parameter("azimuth_starts").value == 5
        descriptor = node.describe_parameter("azimuth_starts")
        assert "viewpoints" in descriptor.description
        assert (descriptor.integer_range[0].from_value, descriptor.integer_range[0].to_value) == (1, 64)
        assert "[m]" in node.describe_parameter("assumed_height_m").description


def test_an_override_goes_before_the_configuration(context):
    with initializer(context, InitializerConfig(azimuth_starts=5), azimuth_starts=3) as node:
        assert node.config.azimuth_starts == 3


@pytest.mark.parametrize(("name", "value"), [("azimuth_starts", 0), ("azimuth_starts", "many"), ("sparsity", -1.0)])
def test_an_override_outside_its_range_is_refused_at_construction(context, name, value):
    with pytest.raises(ParameterError, match=name), initializer(context, **{name: value}):
        pass


def test_malformed_messages_are_counted_explained_and_survived():
    capture = simulate_capture(0.2, 10.0, seed=0).tracks
    good = pose2d_to_ros(
        PoseObservation(
            1_000_000_000,
            1,
            capture.image_size,
            keypoints=capture.keypoints[0].astype(np.float32),
            covariance=capture.covariance[0].astype(np.float32),
            confidence=capture.confidence[0].astype(np.float32),
        ),
        "camera",
    )
    bad = []
    for name, value in (
        ("keypoints", array("f", [1.0] * 29)),
        ("keypoints", array("f", [float("inf")] * 30)),
        ("keypoints", array("f", [0.0] * 100_000)),
        ("covariance", array("f")),
        ("covariance", array("f", [-1.0] * 45)),
        ("skeleton", "octopus"),
        ("image_width", 0),
    ):
        message = pose2d_to_ros(PoseObservation(1, 1, (640, 480)), "camera")
        for field in ("header", "skeleton", "image_width", "image_height", "keypoints", "covariance", "confidence"):
            setattr(message, field, getattr(good, field))
        setattr(message, name, value)
        bad.append(message)
    with bringup(DrocapConfig(), ["initializer"]) as graph:
        poses, reports = [], []
        graph.node.create_subscription(TOPICS["pose3d/initial"].message, "pose3d/initial", poses.append, RESULT_QOS)
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", reports.append, RESULT_QOS)
        publisher = graph.node.create_publisher(TOPICS["pose2d"].message, "pose2d", RESULT_QOS)
        graph.wait_until(publisher.get_subscription_count, 20, "the node to listen")
        for message in [*bad, good]:
            publisher.publish(message)
        graph.wait_until(lambda: poses, 20, "a pose from the good message")

        def counted():
            values = {v.key: v.value for m in reports for v in m.status[0].values}
            return values.get("messages refused") == str(len(bad))

        graph.wait_until(counted, 20, "the refusals on /diagnostics")
    assert len(poses) == 1


def test_a_node_runs_without_a_bringup(context):
    # As with `ros2 run`: no peers are named, so it starts at once.
    with initializer(context) as node:
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        for _ in range(100):
            executor.spin_once(timeout_sec=0.05)
            if node.started:
                break
        executor.shutdown()
        assert node.started


@pytest.mark.parametrize("runs", [False, True])
def test_only_who_is_started_in_a_running_graph_begins_without_a_sign_to_all(context, runs):
    # A sign to start that is lost on the way would be repeated, but a restarted node is waited for.
    with initializer(context, graph_nodes="initializer", graph_runs=runs) as node:
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        end = time.monotonic() + 5.0
        while not node.ready and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        executor.shutdown()
        assert node.ready
        assert node.started is runs
        # Whoever is waited for steps back behind the others later.
        assert node.settled is not runs
