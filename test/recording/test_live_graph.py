"""The recorder, the player and the live method, in the running graph."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="no ROS here: `make setup` brings it")
pytest.importorskip("drocap_ros.msg", reason="the messages are not built: `make setup` builds them")

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.live_replay import reconstruct_live, recorded_config
from drocap_ros.pipeline import reconstruct_input
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, TOPICS

FLIGHT = ("capture_simulator", "initializer", "bundle_adjuster", "session_recorder")


def flight_config(session_dir, seconds=4.0):
    config = DrocapConfig().replace("capture_simulator", seconds=seconds, rate_hz=15.0, seed=3)
    config = config.replace("bundle_adjuster", limb_iterations=3, period_s=0.5)
    return config.replace("session_recorder", session_dir=str(session_dir))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight") / "session"
    with bringup(flight_config(folder), FLIGHT, processes=True) as graph:
        graph.wait_finished("capture_simulator", timeout_s=60)
    return folder


def test_the_offline_replay_equals_the_live_graph_bit_for_bit(flown):
    with open_session(flown) as session:
        config = recorded_config(session)
        assert config.bundle_adjuster == flight_config(flown).bundle_adjuster
        motion, tracks, agreement = reconstruct_live(session, config)
        assert session.warnings == []
    assert agreement.initial == [60, 60]
    assert agreement.windows[0] >= 5
    assert agreement.windows[0] == agreement.windows[1]
    assert len(tracks) == len(motion.joints3d) == 60
    # The comparison notices other parameters.
    with open_session(flown) as session:
        other = config.replace("bundle_adjuster", limb_iterations=2)
        _, _, agreement = reconstruct_live(session, other)
    assert agreement.initial == [60, 60]
    assert agreement.windows[1] < agreement.windows[0]


THREADS = """
import sys, numpy as np
from drocap_ros.config import DrocapConfig
from drocap_ros.pipeline import reconstruct_input
for method in ("live", "ba"):
    motion, _ = reconstruct_input(sys.argv[1], method=method, config=DrocapConfig())
    np.save(f"{sys.argv[2]}_{method}.npy", motion.joints3d)
"""


def test_one_thread_and_two_give_the_same_arrays(flown, tmp_path):
    import os

    for threads in ("1", "2"):
        env = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        subprocess.run([sys.executable, "-c", THREADS, str(flown), str(tmp_path / threads)], check=True, env=env)
    for method in ("live", "ba"):
        one, two = (np.load(tmp_path / f"{threads}_{method}.npy") for threads in ("1", "2"))
        assert np.isfinite(one).all()
        assert np.array_equal(one, two)


def test_the_command_takes_the_recorded_parameters(flown):
    motion, _ = reconstruct_input(flown, method="live", config=DrocapConfig())
    assert motion.meta["parameters"]["adjuster"]["limb_iterations"] == 3
    assert "60 of 60 initial poses" in motion.meta["live_agreement"]
    with pytest.raises(InputError, match="expected a recording with pose2d"):
        reconstruct_input(flown.parent / "none.mp4", method="live", config=DrocapConfig())


def test_a_session_holds_its_provenance(flown):
    with open_session(flown) as session:
        metadata = session.info.metadata
    assert metadata["namespace"] == "/drocap"
    assert json.loads(metadata["versions"])["numpy"] == np.__version__
    assert "k: [" in metadata["calibration"]
    for name in ("capture_simulator", "initializer", "bundle_adjuster", "session_recorder"):
        assert f"/**/{name}:" in metadata["configuration"]


def test_a_session_without_a_name_is_named_by_its_date(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bringup(flight_config(""), ["session_recorder"]):
        pass
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("session_20")
    assert (folder / "metadata.yaml").exists()


def play(session, expected, seconds=30.0, **options):
    """Messages of pose2d, pose3d/initial and /clock, and the duration in seconds."""
    config = flight_config("").replace("session_player", session=str(session), **options)
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


def test_replay_feeds_the_graph_as_the_flight_did(flown):
    with open_session(flown) as session:
        tracks = read_pose2d(session)
        live = {
            stamp_from_ros(m.header.stamp): np.array(m.joints) for _, m in session.messages(("/drocap/pose3d/initial",))
        }
    got, took_s = play(flown, 60, rate=4.0, topics="pose2d")
    stamps = [stamp_from_ros(m.header.stamp) for m in got["pose2d"]]
    assert stamps == tracks.stamp_ns.tolist()
    assert 0.5 < took_s < 4.0
    again = {stamp_from_ros(m.header.stamp): np.array(m.joints) for m in got["pose3d/initial"]}
    assert again.keys() == live.keys()
    assert all(np.array_equal(again[stamp], live[stamp]) for stamp in live)
    clock = np.array([stamp_from_ros(m.clock) for m in got["clock"]])
    assert len(clock) > 50
    assert (np.diff(clock) > 0).all()
    assert clock.max() >= tracks.stamp_ns[-1]


def test_replay_from_the_middle_and_without_a_clock(flown):
    with open_session(flown) as session:
        stamp_ns = read_pose2d(session).stamp_ns
        start_s = float(stamp_ns[20] - session.info.start_ns) * 1e-9
    got, _ = play(flown, 38, rate=20.0, topics="pose2d", start_s=start_s, clock=False)
    assert 38 <= len(got["pose2d"]) <= 41  # the recorder had them a moment later than their stamps
    assert not got["clock"]


def test_replay_refuses_what_it_cannot_do(flown, tmp_path):
    for options, words in (
        ({"topics": "nothing"}, "expected topic 'nothing'"),
        ({"start_s": 1e4}, "the session's length"),
        ({"session": str(tmp_path / "none")}, "no such file"),
        ({"session": ""}, "name one"),
    ):
        config = DrocapConfig().replace("session_player", **{"session": str(flown), **options})
        with pytest.raises(InputError, match=words) as error, bringup(config, ["session_player"]):
            pytest.fail("it came up")
        assert "\n" not in str(error.value)


def test_replay_in_a_loop_until_it_is_stopped(flown):
    config = DrocapConfig().replace("session_player", session=str(flown), loop=True, rate=50.0, topics="pose2d")
    seen = []
    with bringup(config, ["session_player"]) as graph:
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", seen.append, TOPICS["pose2d"].qos)
        graph.wait_until(lambda: len(seen) > 130, 30, "a second round")
        assert "session_player" not in graph.finished
    stamps = [stamp_from_ros(m.header.stamp) for m in seen]
    assert (np.diff(stamps) < 0).any()


def test_pictures_wait_for_a_recorder_that_was_not_let_run_and_too_many_are_counted(tmp_path):
    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "s"))
    with bringup(config, ["session_recorder"], processes=True) as graph:
        states, recorder = [], graph.pid("session_recorder")
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, 100)
        pictures = graph.node.create_publisher(CompressedImage, "image/compressed", IMAGE_RECORDING_QOS)
        graph.wait_until(lambda: pictures.get_subscription_count() == 1, 20, "the recorder")

        def publish_while_it_stands(count):
            os.kill(recorder, signal.SIGSTOP)
            for _ in range(count):
                pictures.publish(CompressedImage(format="jpeg", data=b"x"))
            os.kill(recorder, signal.SIGCONT)

        def told(key):
            return [int(v.value) for m in states for s in m.status for v in s.values if key in v.key][-1:]

        publish_while_it_stands(120)
        graph.wait_until(lambda: told("messages") and told("messages")[0] >= 120, 20, "120 pictures")
        assert not told(Key.MISSED)
        publish_while_it_stands(1000)
        graph.wait_until(lambda: told(Key.MISSED), 20, "the count of what was too much")
        graph.spin_for(2.1)
        missed = told(Key.MISSED)[0]
    with open_session(tmp_path / "s") as session:
        recorded = next(t.count for t in session.info.topics if t.name.endswith("image/compressed"))
    assert recorded + missed == 1120


def test_a_disk_that_fills_up_is_told_and_the_others_live_on(small_disk):
    config = flight_config(small_disk / "s", seconds=60.0).replace("session_recorder", free_mib=0, compression="none")
    with bringup(config, ["capture_simulator", "session_recorder"]) as graph:
        states, poses = [], []
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, 100)
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", poses.append, TOPICS["pose2d"].qos)
        pictures = graph.node.create_publisher(CompressedImage, "image/compressed", IMAGE_RECORDING_QOS)
        picture = CompressedImage(format="jpeg", data=np.zeros(400_000, np.uint8).tobytes())

        def told():
            pictures.publish(picture)
            return [
                s for m in states for s in m.status if "session_recorder" in s.name and "No space left" in s.message
            ]

        graph.wait_until(told, 40, "an error on /diagnostics")
        status = told()[-1]
        assert status.level == b"\x02"
        assert "make room" in status.message
        before = len(poses)
        graph.wait_until(lambda: len(poses) > before + 15, 20, "more poses")
        graph.wait_until(lambda: any(Key.NOT_WRITTEN in v.key for v in told()[-1].values), 20, "the drops")
    with open_session(small_disk / "s") as session:
        assert session.info.message_count > 10
