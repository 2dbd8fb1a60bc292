"""Node ``session_recorder`` in a running graph."""

import json
import os
import signal
import time

import numpy as np
import rclpy
from captured_flight import FLIGHT, flight_config
from rclpy.clock import ClockType
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, CompressedImage

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.nodes.session_recorder import SessionRecorderNode
from drocap_ros.recording.mcap.session_config import SessionRecorderConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, KEPT_QOS, TOPICS


def test_a_session_holds_its_provenance(tmp_path):
    with bringup(flight_config(tmp_path / "s", tmp_path, seconds=0.5), FLIGHT) as graph:
        graph.wait_finished("session_player", timeout_s=60)
    with open_session(tmp_path / "s") as session:
        metadata = session.info.metadata
    assert metadata["namespace"] == "/drocap"
    assert json.loads(metadata["versions"])["numpy"] == np.__version__
    assert "k: [" in metadata["calibration"]
    for name in FLIGHT:
        assert f"/**/{name}:" in metadata["configuration"]


def test_a_session_without_a_name_is_named_by_its_date(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with bringup(DrocapConfig(), ["session_recorder"]):
        pass
    (folder,) = tmp_path.iterdir()
    assert folder.name.startswith("session_20")
    assert (folder / "metadata.yaml").exists()


def test_images_wait_for_a_stopped_recorder_and_excess_images_are_counted(tmp_path):
    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "s"))
    with bringup(config, ["session_recorder"], processes=True) as graph:
        states, recorder = [], graph.pid("session_recorder")
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, 100)
        images = graph.node.create_publisher(CompressedImage, "image/compressed", IMAGE_RECORDING_QOS)
        graph.wait_until(lambda: images.get_subscription_count() == 1, 20, "the recorder")

        def publish_while_stopped(count):
            os.kill(recorder, signal.SIGSTOP)
            for _ in range(count):
                images.publish(CompressedImage(format="jpeg", data=b"x"))
            os.kill(recorder, signal.SIGCONT)

        def counted(key):
            return [int(v.value) for m in states for s in m.status for v in s.values if key in v.key][-1:]

        publish_while_stopped(120)
        graph.wait_until(lambda: counted("messages") and counted("messages")[0] >= 120, 20, "120 images")
        assert not counted(Key.MISSED)
        publish_while_stopped(1000)
        graph.wait_until(lambda: counted(Key.MISSED), 20, "the count of missed images")
        graph.spin_for(2.1)
        missed = counted(Key.MISSED)[0]
    with open_session(tmp_path / "s") as session:
        recorded = next(t.count for t in session.info.topics if t.name.endswith("image/compressed"))
    assert recorded + missed == 1120


def test_a_full_disk_is_an_error_of_the_recorder_alone(small_disk, tmp_path):
    config = flight_config(small_disk / "s", tmp_path, seconds=60.0).replace(
        "session_recorder", free_mib=0, compression="none"
    )
    with bringup(config, ["session_player", "session_recorder"]) as graph:
        states, poses = [], []
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, 100)
        graph.node.create_subscription(TOPICS["pose2d"].message, "pose2d", poses.append, TOPICS["pose2d"].qos)
        images = graph.node.create_publisher(CompressedImage, "image/compressed", IMAGE_RECORDING_QOS)
        image = CompressedImage(format="jpeg", data=np.zeros(400_000, np.uint8).tobytes())

        def errors():
            images.publish(image)
            return [
                s for m in states for s in m.status if "session_recorder" in s.name and "No space left" in s.message
            ]

        graph.wait_until(errors, 40, "an error on /diagnostics")
        status = errors()[-1]
        assert status.level == b"\x02"
        assert "make room" in status.message
        before = len(poses)
        graph.wait_until(lambda: len(poses) > before + 15, 20, "more poses")
        graph.wait_until(lambda: any(Key.NOT_WRITTEN in v.key for v in errors()[-1].values), 20, "the drops")
    with open_session(small_disk / "s") as session:
        assert session.info.message_count > 10


def test_message_that_is_none_is_refused_and_the_recording_continues(tmp_path):
    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "s"))
    with bringup(config, ["session_recorder"]) as graph:
        states = []
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", states.append, 100)
        for topic in ("/diagnostics", "camera_info"):
            publisher = graph.node.create_publisher(TOPICS[topic].message, topic, TOPICS[topic].qos)
            graph.wait_until(lambda p=publisher: p.get_subscription_count() >= 1, 20, "the recorder")
            publisher.publish(b"\0\1\0\0\0\0")  # CDR that ends within the header

        def refused():
            values = [v for m in states for s in m.status for v in s.values]
            return [v.value for v in values if v.key == Key.MESSAGES_REFUSED][-1:]

        graph.wait_until(lambda: refused() == ["2"], 10, "two refusals")


def test_a_drivers_camera_info_of_best_effort_is_recorded(tmp_path):
    config = DrocapConfig().replace("session_recorder", session_dir=str(tmp_path / "s"))
    with bringup(config, ["session_recorder"]) as graph:
        driver = graph.node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
        graph.wait_until(lambda: driver.get_subscription_count() == 1, 10, "the recorder")
        driver.publish(CameraInfo(width=640))
        graph.spin_for(0.2)
    with open_session(tmp_path / "s") as session:
        assert "width: 640" in session.info.metadata["calibration"]


def test_a_camera_info_that_was_published_once_before_is_recorded_once(tmp_path):
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        driver = rclpy.create_node("driver", context=context, use_global_arguments=False)
        publisher = driver.create_publisher(CameraInfo, "/drocap/camera_info", KEPT_QOS)
        publisher.publish(CameraInfo(width=640))
        config = SessionRecorderConfig(session_dir=str(tmp_path / "s"))
        node = SessionRecorderNode(config, context=context, use_global_arguments=False)
        executor = EventsExecutor(context=context)
        executor.add_node(node)
        try:
            wait_for(executor, lambda: node._calibrated and publisher.get_subscription_count() == 1)
            first_s = node._heard_s["camera_info"]
            publisher.publish(CameraInfo(width=641))
            wait_for(executor, lambda: node._heard_s["camera_info"] > first_s)
        finally:
            executor.shutdown()
            node.close()
            for closed in (node, driver):
                closed.destroy_node()
            context.try_shutdown()
    with open_session(tmp_path / "s") as session:
        assert "width: 640" in session.info.metadata["calibration"]
        assert next(t.count for t in session.info.topics if t.name.endswith("camera_info")) == 2


def wait_for(executor, condition):
    end = time.monotonic() + 10.0
    while not condition() and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.05)
    assert condition()


def test_session_in_simulated_time_does_not_begin_before_the_clock(tmp_path):
    config = SessionRecorderConfig(session_dir=str(tmp_path / "s"))
    given = [Parameter("use_sim_time", value=True)]
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = SessionRecorderNode(config, context=context, use_global_arguments=False, parameter_overrides=given)
        try:
            for now_ns in (0, 5 * 10**9):
                node.get_clock().set_ros_time_override(Time(nanoseconds=now_ns, clock_type=ClockType.ROS_TIME))
                node._on_message("/drocap/roi", bytes(24), {"received_timestamp": 1, "source_timestamp": 1})
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()
    with open_session(tmp_path / "s") as session:
        assert [raw.log_time_ns for raw in session.raw_messages()] == [5 * 10**9]
