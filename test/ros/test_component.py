"""Base class of all nodes, on live nodes."""

import contextlib
import signal
import time

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter

from drocap_ros.errors import ParameterError
from drocap_ros.nodes.initializer import InitializerNode
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import RESULT_QOS, TOPICS


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
    with initializer(context, InitializerConfig(search_azimuths=5)) as node:
        assert node.get_parameter("search_azimuths").value == 5
        descriptor = node.describe_parameter("search_azimuths")
        assert "viewpoints" in descriptor.description
        assert (descriptor.integer_range[0].from_value, descriptor.integer_range[0].to_value) == (1, 64)
        assert "[m]" in node.describe_parameter("assumed_height_m").description


def test_node_without_a_clock_reports_that(context, monkeypatch):
    monkeypatch.setattr("drocap_ros.ros.component._CLOCK_STANDS_S", 0.3)
    with initializer(context, use_sim_time=True) as node:
        states = []
        node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, RESULT_QOS)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        end_s = time.monotonic() + 10.0
        while time.monotonic() < end_s and not any("/clock has not come yet" in m.status[0].message for m in states):
            executor.spin_once(timeout_sec=0.1)
        executor.shutdown()
        assert "/clock has not come yet" in states[-1].status[0].message


def test_override_takes_precedence_over_the_configuration(context):
    with initializer(context, InitializerConfig(search_azimuths=5), search_azimuths=3) as node:
        assert node.config.search_azimuths == 3


@pytest.mark.parametrize(("name", "value"), [("search_azimuths", 0), ("search_azimuths", "many"), ("sparsity", -1.0)])
def test_override_outside_its_range_is_refused_at_construction(context, name, value):
    with pytest.raises(ParameterError, match=name), initializer(context, **{name: value}):
        pass


def spin_until_ready(context, node, seconds):
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    end = time.monotonic() + seconds
    while not node.ready and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)
    executor.shutdown()


def test_node_without_a_bringup_is_ready_at_once(context):
    with initializer(context) as node:
        spin_until_ready(context, node, 5.0)
        assert node.ready


def test_node_of_a_graph_is_not_ready_without_its_peers(context):
    with initializer(context, graph_nodes="pose_estimator,initializer") as node:
        spin_until_ready(context, node, 0.5)
        assert not node.ready
        assert node.details[Key.READY] == "false"


class EveryInfo(InitializerNode):
    """Counts what a subscription with message info receives."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.infos = []
        self.input("pose3d/latest", lambda message, info: self.infos.append(info), with_info=True)


@pytest.mark.parametrize("kind", [SingleThreadedExecutor, EventsExecutor])
def test_message_info_reaches_the_callback_under_either_executor(context, kind):
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    node = EveryInfo(context=context, use_global_arguments=False)
    executor = kind(context=context)
    executor.add_node(node)
    publisher = node.create_publisher(TOPICS["pose3d/latest"].message, "pose3d/latest", RESULT_QOS)
    try:
        end = time.monotonic() + 10.0
        while len(node.infos) < 3 and time.monotonic() < end:
            publisher.publish(TOPICS["pose3d/latest"].message())
            executor.spin_once(timeout_sec=0.05)
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    first, second, third = (info["publication_sequence_number"] for info in node.infos[:3])
    assert (second, third) == (first + 1, first + 2)
    assert node.infos[0]["received_timestamp"] > 0
