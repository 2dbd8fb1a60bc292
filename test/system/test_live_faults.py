"""Nodes that are killed in a running graph and restarted."""

import os
import time

import pytest
from captured_flight import captured_config

from drocap_ros.bringup import bringup
from drocap_ros.errors import InputError, NodeError
from drocap_ros.msg import OrbitStatus, Pose3D, Pose3DWindow
from drocap_ros.recording.open_session import open_session
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.topics import RESULT_QOS, TOPICS
from drocap_ros.simulation.vehicle.loopback import free_udp_port

NODES = ["session_player", "initializer", "bundle_adjuster", "mavlink_bridge", "session_recorder"]
#: Topic that proves that a node works, the source excepted.
SIGN = {
    "initializer": ("pose3d/initial", Pose3D),
    "bundle_adjuster": ("pose3d/refined", Pose3DWindow),
    "mavlink_bridge": ("orbit/status", OrbitStatus),
}


def flight(session, seconds=40.0):
    config = captured_config(session.parent, seconds)
    config = config.replace("bundle_adjuster", iterations=5, period_s=0.5)
    config = config.replace("mavlink_bridge", url=f"udpin:127.0.0.1:{free_udp_port()}")
    return config.replace("session_recorder", session_dir=str(session))


def test_each_killed_node_restarts_and_costs_the_others_no_message(tmp_path):
    session = tmp_path / "session"
    with bringup(flight(session), NODES, processes=True, respawn=True) as graph:
        heard = {name: [] for name in SIGN}
        for name, (topic, kind) in SIGN.items():
            graph.node.create_subscription(kind, topic, heard[name].append, RESULT_QOS)
        statuses, reports = [], []
        graph.node.create_subscription(OrbitStatus, "orbit/status", statuses.append, RESULT_QOS)
        entry = TOPICS["/diagnostics"]
        graph.node.create_subscription(entry.message, "/diagnostics", reports.append, entry.qos)
        graph.wait_until(lambda: all(heard.values()), 30, "every node to work")
        for name, messages in heard.items():
            os.kill(graph.pid(name), 9)
            graph.wait_until(lambda name=name: graph.restarts[name], 10, f"{name} to be restarted")
            messages.clear()
            begin = time.monotonic()
            graph.wait_until(lambda messages=messages: messages, 20, f"{name} to work again")
            assert time.monotonic() - begin < 6.0, name
        os.kill(graph.pid("session_recorder"), 9)
        second = tmp_path / "session_2"
        graph.wait_until(lambda: any(second.glob("*.mcap")), 10, "the recorder's next folder")
        before = len(heard["initializer"])
        graph.wait_until(lambda: len(heard["initializer"]) > before + 20, 20, "messages for it")
        reported = [s.message for m in reports for s in m.status if s.name == "drocap/bringup"]
    assert any("initializer restarted" in text for text in reported)
    assert dict(graph.restarts) == dict.fromkeys(NODES[1:], 1)

    # Between its first and last message each recording holds every message received here.
    heard_ns = {stamp_from_ros(message.header.stamp) for message in statuses}
    for folder in (session, second):
        with open_session(folder) as opened:
            recorded = [stamp_from_ros(m.header.stamp) for _, m in opened.messages(("/drocap/orbit/status",))]
        assert len(recorded) > 5
        assert {stamp for stamp in heard_ns if recorded[0] <= stamp <= recorded[-1]} <= set(recorded)


def test_node_restarted_by_the_script_in_one_process_works_again(tmp_path):
    nodes = NODES[:2]
    with bringup(flight(tmp_path / "session"), nodes) as graph:
        poses = []
        graph.node.create_subscription(Pose3D, "pose3d/initial", poses.append, RESULT_QOS)
        graph.wait_until(lambda: poses, 20, "poses")
        graph.restart("initializer")
        graph.wait_ready("initializer", timeout_s=10)
        poses.clear()
        graph.wait_until(lambda: poses, 5, "poses again")
        with pytest.raises(InputError, match="restart: expected one of"):
            graph.restart("visualizer")


def kill_repeatedly(session):
    with bringup(flight(session), NODES[:2], processes=True, respawn=True) as graph:
        for number in range(20):
            os.kill(graph.pid("initializer"), 9)
            graph.wait_until(lambda number=number: graph.restarts["initializer"] > number, 30)


def test_node_that_keeps_dying_ends_the_graph(tmp_path, monkeypatch):
    monkeypatch.setattr("drocap_ros.ros.graph.FIRST_PAUSE_S", 0.05)
    with pytest.raises(NodeError, match="initializer ended with status -9"):
        kill_repeatedly(tmp_path / "session")
