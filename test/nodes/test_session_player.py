"""Node ``session_player`` in a running graph."""

import time

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.recording.mcap.metadata import schema_text
from drocap_ros.recording.mcap.writer import SessionWriter
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.topics import TOPICS


def play(session, expected, seconds=30.0, **options):
    """Messages of pose2d, pose3d/initial and /clock, and the duration in seconds."""
    config = DrocapConfig().replace("session_player", session=str(session), **options)
    got = {"pose2d": [], "pose3d/initial": [], "clock": []}
    with bringup(config, ["session_player", "initializer"]) as graph:
        for topic in ("pose2d", "pose3d/initial"):
            graph.node.create_subscription(TOPICS[topic].message, topic, got[topic].append, TOPICS[topic].qos)
        graph.node.create_subscription(Clock, "/clock", got["clock"].append, 100)
        begin = time.monotonic()
        graph.wait_finished("session_player", timeout_s=seconds)
        took_s = time.monotonic() - begin
        graph.wait_until(lambda: len(got["pose3d/initial"]) >= expected, 20, "the initial poses")
    return got, took_s


def test_a_replay_repeats_the_initial_poses_of_the_flight(captured):
    with open_session(captured) as session:
        tracks = read_pose2d(session)
        live = {
            stamp_from_ros(m.header.stamp): np.array(m.joints) for _, m in session.messages(("/drocap/pose3d/initial",))
        }
    got, took_s = play(captured, 60, rate=1.5, topics="pose2d")
    stamps = [stamp_from_ros(m.header.stamp) for m in got["pose2d"]]
    assert stamps == tracks.stamp_ns.tolist()
    assert 2.0 < took_s < 6.0
    again = {stamp_from_ros(m.header.stamp): np.array(m.joints) for m in got["pose3d/initial"]}
    assert again.keys() == live.keys()
    assert all(np.array_equal(again[stamp], live[stamp]) for stamp in live)
    clock = np.array([stamp_from_ros(m.clock) for m in got["clock"]])
    assert len(clock) > 50
    assert (np.diff(clock) > 0).all()
    assert clock.max() >= tracks.stamp_ns[-1]


def test_a_replay_starts_in_the_middle_after_a_delay_and_without_a_clock(captured):
    with open_session(captured) as session:
        log_ns = [raw.log_time_ns for raw, _ in session.messages(("/drocap/pose2d",))]
        start_s = (log_ns[20] - session.info.start_ns) * 1e-9
    got, took_s = play(captured, 10, rate=20.0, topics="pose2d", start_s=start_s, delay_s=1.5, clock=False)
    assert took_s > 1.4
    # The initializer, which is slower than that, passes over some.
    assert 38 <= len(got["pose2d"]) <= 41  # messages were recorded a moment after their stamps
    assert not got["clock"]


def test_impossible_replays_are_refused_in_one_line(captured, tmp_path):
    for options, words in (
        ({"topics": "nothing"}, "expected topic 'nothing'"),
        ({"start_s": 1e4}, "the session's length"),
        ({"session": str(tmp_path / "none")}, "no such file"),
        ({"session": ""}, "name one"),
    ):
        config = DrocapConfig().replace("session_player", **{"session": str(captured), **options})
        with pytest.raises(InputError, match=words) as error, bringup(config, ["session_player"]):
            pytest.fail("it came up")
        assert "\n" not in str(error.value)


def test_tf_of_another_namespace_is_published_in_the_players_own(tmp_path):
    kind = "tf2_msgs/msg/TFMessage"
    pytest.importorskip("tf2_msgs")
    with SessionWriter(tmp_path / "s", metadata={"namespace": "/drone2"}) as writer:
        writer.register("/drone2/tf", kind, schema_text(kind))
        writer.write("/drone2/tf", bytes([0, 1, 0, 0, 0, 0, 0, 0]), 10**9)
    config = DrocapConfig().replace("session_player", session=str(tmp_path / "s"))
    for namespace, topic in (("/drocap", "/tf"), ("/drone3", "/drone3/tf")):
        with bringup(config, ["session_player"], namespace=namespace) as graph:
            graph.wait_until(lambda g=graph, t=topic: g.node.count_publishers(t) == 1, 10, "TF in the namespace")


def test_a_loop_repeats_until_it_is_stopped(captured):
    config = DrocapConfig().replace("session_player", session=str(captured), loop=True, rate=50.0, topics="pose2d")
    seen = []
    with bringup(config, ["session_player"]) as graph:
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", seen.append, TOPICS["pose2d"].qos)
        graph.wait_until(lambda: len(seen) > 130, 30, "a second round")
        assert "session_player" not in graph.finished
    stamps = [stamp_from_ros(m.header.stamp) for m in seen]
    assert (np.diff(stamps) < 0).any()
