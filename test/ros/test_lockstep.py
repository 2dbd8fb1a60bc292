"""A graph in simulated time: what it does depends on the steps of the clock alone."""

import time

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from drocap_ros.bringup import lockstep
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError, NodeError
from drocap_ros.ros.lockstep import EPOCH_NS
from drocap_ros.ros.topics import TOPICS
from drocap_ros.simulation.vehicle.loopback import Channel, LoopbackTransport

S = 10**9


@pytest.fixture
def graph():
    with lockstep(DrocapConfig(), ["initializer", "visualizer"]) as graph:
        yield graph


def diagnostics(graph):
    """Times, names and texts of the diagnostics that the graph receives from now on."""
    seen = []

    def take(message):
        stamp = message.header.stamp
        seen.append((stamp.sec * S + stamp.nanosec - EPOCH_NS, message.status[0].name, message.status[0].message))

    graph.node.create_subscription(DiagnosticArray, "/diagnostics", take, TOPICS["/diagnostics"].qos)
    return seen


def test_timers_run_at_their_instants_of_the_simulated_time_in_the_order_of_the_nodes(graph, monkeypatch):
    seen = diagnostics(graph)
    graph.start()
    graph.run_for(1.0)
    time.sleep(1.5)  # a slow machine
    much_later_s = time.monotonic() + 3600.0
    monkeypatch.setattr(time, "monotonic", lambda: much_later_s)
    graph.run_for(2.0)
    # Timers were due when the time began.
    at = [10_000_000, S, 2 * S, 3 * S]
    assert seen == [(t, f"drocap/{name}", "running") for t in at for name in ("initializer", "visualizer")]


def test_a_viewer_that_joins_hears_what_is_published_from_then_on(graph):
    own, carried = diagnostics(graph), []
    publisher = next(p for _, p in graph.components[0].outputs if p.topic_name == "/diagnostics")
    publish = publisher.publish
    publisher.publish = lambda message: (carried.append(message), publish(message))
    graph.start()
    carried.clear()
    graph.run_for(2.0)
    assert len(own) > 2
    assert not carried  # the nodes hear each other without the middleware
    heard = {"/diagnostics": [], "/clock": []}
    viewer = Node("viewer", context=graph.node.context)
    viewer.create_subscription(DiagnosticArray, "/diagnostics", heard["/diagnostics"].append, 10)
    viewer.create_subscription(Clock, "/clock", heard["/clock"].append, 10)
    executor = SingleThreadedExecutor(context=graph.node.context)
    executor.add_node(viewer)
    end_s = time.monotonic() + 30.0
    while not all(heard.values()) and time.monotonic() < end_s:
        graph.run_for(0.1)
        executor.spin_once(0.05)
    viewer.destroy_node()
    assert all(heard.values())


def test_wait_is_bounded_in_simulated_time(graph):
    diagnostics(graph)
    graph.start()
    with pytest.raises(NodeError, match=r"waited 0\.5 s of simulated time for the moon"):
        graph.run_until(lambda: False, 0.5, "the moon")
    assert graph.now_s == pytest.approx(0.5)
    assert graph.now_ns == EPOCH_NS + S // 2


def test_clock_of_a_running_node_stays(graph):
    node = graph.components[0]
    results = node.set_parameters([Parameter("use_sim_time", value=False)])
    assert not results[0].successful
    assert "start" in results[0].reason
    assert node.get_clock().ros_time_is_active


def test_motion_in_simulated_time_needs_a_simulated_autopilot():
    config = DrocapConfig().replace("mavlink_bridge", commands_enabled=True, url="udpin:127.0.0.1:14599")
    with pytest.raises(InputError, match="use_sim_time: expected false"), lockstep(config, ["mavlink_bridge"]):
        pass
    channels = [Channel(lambda: graph.now_s) for _ in range(2)]
    with lockstep(config, ["mavlink_bridge"], transports={"mavlink_bridge": LoopbackTransport(*channels)}) as graph:
        diagnostics(graph)
        graph.start()
        graph.run_for(0.1)
        assert channels[1].read()  # heartbeats
