"""The graph, brought up from a script."""

import os
import re
import stat
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from captured_flight import captured_config
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from drocap_ros.bringup import bringup, free_domain, lockstep, node_class
from drocap_ros.config import DrocapConfig, section_types
from drocap_ros.errors import InputError
from drocap_ros.msg import Pose2D, Pose3D, Pose3DWindow
from drocap_ros.ros.conversions import stamp_from_ros
from drocap_ros.ros.topics import NODES, TOPICS

CAPTURE = ["session_player", "initializer", "bundle_adjuster"]


def short_flight(folder, seconds=3.0, seed=0, **adjuster):
    # Short solves: these tests are about the graph, not about accuracy.
    config = captured_config(folder, seconds, seed=seed)
    return config.replace("bundle_adjuster", **{"iterations": 10, **adjuster})


def collect(graph, *topics):
    got = {topic: [] for topic in topics}
    for topic, messages in got.items():
        graph.node.create_subscription(TOPICS[topic].message, topic, messages.append, TOPICS[topic].qos)
    return got


@pytest.mark.parametrize("processes", [False, True], ids=["one process", "a process each"])
def test_nothing_is_lost_at_the_start_and_every_keypoint_becomes_a_pose(processes, tmp_path):
    with bringup(short_flight(tmp_path), CAPTURE, processes=processes) as graph:
        got = collect(graph, "pose2d", "pose3d/initial", "pose3d/refined", "pose3d/latest")
        graph.wait_finished("session_player", timeout_s=60)
        graph.wait_until(lambda: len(got["pose3d/initial"]) >= 45, 20, "45 initial poses")
        graph.wait_until(lambda: got["pose3d/refined"], 20, "an adjusted window")
    keypoints, poses = got["pose2d"], got["pose3d/initial"]
    assert len(keypoints) == len(poses) == 45
    stamps = [stamp_from_ros(m.header.stamp) for m in keypoints]
    assert stamps == [stamp_from_ros(m.header.stamp) for m in poses]
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 15, atol=2)
    assert all(isinstance(m, Pose2D) and m.skeleton == "body15" for m in keypoints)
    assert all(m.stage == Pose3D.INITIAL and np.isfinite(m.joints).all() for m in poses)
    window = got["pose3d/refined"][-1]
    assert isinstance(window, Pose3DWindow)
    assert len(window.poses) > 10
    assert window.iterations > 0
    assert window.stop_reason
    # The latest pose comes with each image: the initial one until there is a solution, corrected from then on.
    stages = [m.stage for m in got["pose3d/latest"]]
    assert stages == sorted(stages)
    assert set(stages) <= {Pose3D.INITIAL, Pose3D.REFINED}
    assert stages[-1] == Pose3D.REFINED


def test_free_domain_is_given_once():
    with free_domain() as first, free_domain() as second:
        assert first != second


@pytest.mark.parametrize("processes", [False, True], ids=["one process", "a process each"])
def test_refusal_of_a_node_is_raised_by_the_bringup(processes, tmp_path):
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path / "none.mp4"))
    with pytest.raises(InputError, match=r"none\.mp4"), bringup(config, ["image_ingest"], processes=processes):
        pytest.fail("the graph came up without its source")


def test_unknown_node_is_refused():
    with pytest.raises(InputError, match="expected some of"), bringup(DrocapConfig(), ["pose_estimater"]):
        pass


def test_priority_of_a_process_follows_the_table_in_the_session_and_out_of_the_group_of_the_command(tmp_path):
    with bringup(short_flight(tmp_path), [*CAPTURE, "visualizer"], processes=True) as graph:
        drawing, simulator = graph.pid("visualizer"), graph.pid("session_player")
        threads, niceness = Path(f"/proc/{drawing}/task"), NODES["visualizer"].niceness
        graph.wait_until(  # one thread after the other
            lambda: all(os.getpriority(os.PRIO_PROCESS, int(path.name)) == niceness for path in threads.iterdir()),
            20,
            "the visualizer's priority",
        )
        assert os.sched_getscheduler(drawing) == os.SCHED_BATCH
        assert os.sched_getscheduler(simulator) == os.SCHED_OTHER
        assert os.getpriority(os.PRIO_PROCESS, simulator) == os.getpriority(os.PRIO_PROCESS, 0)
        # Niceness acts within a session only; Ctrl-C reaches the command's process group only.
        assert os.getsid(drawing) == os.getsid(simulator) == os.getsid(0)
        assert {os.getpgid(drawing), os.getpgid(simulator)} == {drawing, simulator}


@pytest.mark.skipif(
    os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") != "rmw_fastrtps_cpp"
    or "FASTRTPS_DEFAULT_PROFILES_FILE" in os.environ,
    reason="another middleware, or somebody's own profile",
)
def test_no_node_uses_shared_memory_also_not_for_the_images_of_a_driver(tmp_path):
    def uses_it(name):
        return "/dev/shm/fast" in Path(f"/proc/{graph.pid(name)}/maps").read_text()

    config = short_flight(tmp_path, seconds=10.0).replace("image_ingest", source="topic:camera/image_raw")
    picture = Image(height=240, width=320, encoding="bgr8", step=3 * 320, data=bytes(3 * 320 * 240))
    with bringup(config, ["image_ingest", "session_player", "initializer"], processes=True) as graph:
        got = collect(graph, "image/compressed")["image/compressed"]
        driver = graph.node.create_publisher(Image, "camera/image_raw", qos_profile_sensor_data)
        graph.wait_until(driver.get_subscription_count, 20, "the node to listen")
        for _ in range(100):
            picture.header.stamp = graph.node.get_clock().now().to_msg()
            driver.publish(picture)
            graph.spin_for(0.1)
            if len(got) >= 5:
                break
        assert len(got) >= 5
        assert not any(uses_it(name) for name in graph.names)


def test_images_larger_than_the_kernels_buffers_reach_the_estimator(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (1000, 1400, 3), dtype=np.uint8)
    for i in range(15):
        cv2.imwrite(str(tmp_path / f"{i:02d}.jpg"), np.roll(noise, 10 * i, axis=1))
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path), folder_rate_hz=3.0, realtime=True)
    config = config.replace("pose_estimator", models_dir="simulation")
    with bringup(config, ["image_ingest", "pose_estimator"], processes=True) as graph:
        got = collect(graph, "/diagnostics")["/diagnostics"]

        def images(node):
            counts = [v for m in got for s in m.status if node in s.name for v in s.values]
            return max((int(v.value) for v in counts if v.key == "images"), default=0)

        graph.wait_finished("image_ingest", timeout_s=60)
        graph.spin_for(2.0)
        graph.wait_until(lambda: images("pose_estimator") >= 0.6 * images("image_ingest"), 20, "most of the pictures")
        assert images("image_ingest") >= 5


def test_graph_stops_within_fifteen_seconds(tmp_path):
    with bringup(short_flight(tmp_path, 30.0), CAPTURE[:2]):
        begin = time.monotonic()
    assert time.monotonic() - begin < 15


def test_table_of_the_nodes_names_existing_topics():
    for entry in NODES.values():
        assert set(entry.publishes) | set(entry.subscribes) <= set(TOPICS)


def test_every_node_has_a_module_and_a_section_of_the_configuration():
    assert set(NODES) == set(section_types())
    for name in NODES:
        assert node_class(name).component == name


def test_a_graph_that_ended_leaves_no_socket(tmp_path):
    """Its DDS participants would answer to the next graph of that domain, and keep their threads."""

    def sockets():
        return sum(stat.S_ISSOCK(os.stat(file).st_mode) for file in Path("/proc/self/fd").iterdir() if file.exists())

    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "session"), if_taken="next")
    after = []
    for _ in range(3):  # the first one leaves what the process has once
        with lockstep(config, ["session_recorder"]):
            pass
        after.append(sockets())
    assert len(set(after)) == 1, after


def test_readme_s_example_runs_as_printed(root, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", (root / "README.md").read_text(), re.DOTALL)
    (block,) = (block for block in blocks if "with bringup(" in block)
    (tmp_path / "example.py").write_text(block)
    writer = cv2.VideoWriter(str(tmp_path / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240))
    for _ in range(3):
        writer.write(np.full((240, 320, 3), 90, np.uint8))
    writer.release()
    env = {**os.environ, "PYTHONPATH": str(root), "DROCAP_MODELS": "simulation"}
    command = [sys.executable, "example.py"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
