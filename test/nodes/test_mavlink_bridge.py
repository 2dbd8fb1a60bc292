"""The node around the controller: what it refuses, and what it does when the controller fails."""

import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from bent_lenses import BENT, bent
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.watchdog import FallbackCommands
from drocap_ros.geometry.lens import CameraModel
from drocap_ros.keypoints import PoseObservation
from drocap_ros.nodes.mavlink_bridge import MavlinkBridgeNode
from drocap_ros.ros.conversions import camera_info_to_ros, header_at, pose2d_to_ros
from drocap_ros.ros.topics import KEPT_QOS
from drocap_ros.simulation.pinhole import pinhole_matrix
from drocap_ros.simulation.vehicle.loopback import free_udp_port


@pytest.fixture
def node():
    rclpy.init()
    node = MavlinkBridgeNode(MavlinkBridgeConfig(commands_enabled=True, url=f"udpin:127.0.0.1:{free_udp_port()}"))
    yield node
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_keypoints_of_images_of_another_size_are_refused(node):
    """By a camera_info of larger images the person seems farther away, and the vehicle would come nearer."""
    camera = CameraModel(1280, 720, pinhole_matrix(1280, 720, 60.0))
    node._on_camera_info(camera_info_to_ros(header_at(1, "camera"), camera))

    def take(size):
        node._on_pose2d(pose2d_to_ros(PoseObservation(10**18, 0, size), "camera"), {"publication_sequence_number": 1})

    take((1280, 720))
    with pytest.raises(InputError, match="expected images of 1280x720 as in camera_info, got 960x540"):
        take((960, 540))


@pytest.mark.parametrize("lens", BENT)
def test_the_subject_is_where_a_lens_without_distortion_shows_it(node, lens, monkeypatch):
    matrix, seen = pinhole_matrix(1280, 720, 60.0), []
    true = np.random.default_rng(0).uniform((0, 0), (1280, 720), (15, 2))
    monkeypatch.setattr(node.controller, "on_pose2d", lambda observation: seen.append(observation.keypoints))
    shown = bent(true, matrix, lens).astype(np.float32)
    observation = PoseObservation(10**18, 1, (1280, 720), keypoints=shown, covariance=np.ones((15, 3), np.float32),
                                  confidence=np.ones(15, np.float32))  # fmt: skip
    camera = CameraModel(1280, 720, matrix, np.array(BENT[lens]), lens)
    unknown = replace(camera, distortion_model="foo")
    with pytest.raises(InputError, match=r"the distortion \('foo'.* is of no known form: not used"):
        node._on_camera_info(camera_info_to_ros(header_at(1, "camera"), unknown))
    for known in (False, True):
        if known:
            node._on_camera_info(camera_info_to_ros(header_at(1, "camera"), camera))
        node._on_pose2d(pose2d_to_ros(observation, "camera"), {"publication_sequence_number": 1})
    assert np.array_equal(seen[0], shown)
    assert np.abs(seen[0] - true).max() > 5.0
    assert np.abs(seen[1] - true).max() < 0.5


def test_a_normalised_camera_matrix_is_refused(node):
    camera = CameraModel(1280, 720, pinhole_matrix(1280, 720, 60.0) / 1280)
    camera.matrix[2, 2] = 1.0
    with pytest.raises(InputError, match="expected focal lengths in px"):
        node._on_camera_info(camera_info_to_ros(header_at(1, "camera"), camera))


@pytest.mark.parametrize("reliability", ["BEST_EFFORT", "RELIABLE"])
def test_a_drivers_camera_info_is_heard_whatever_it_offers(node, reliability):
    driver = rclpy.create_node("driver")
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy[reliability], durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = driver.create_publisher(CameraInfo, "/drocap/camera_info", qos)
    camera = CameraModel(1280, 720, pinhole_matrix(1280, 720, 60.0))
    end = time.monotonic() + 5.0
    while not node.controller.calibrated and time.monotonic() < end:
        publisher.publish(camera_info_to_ros(header_at(time.time_ns(), "camera"), camera))
        rclpy.spin_once(node, timeout_sec=0.05)
    driver.destroy_node()
    assert node.controller.calibrated


def test_a_camera_info_that_was_published_once_before_the_bridge_is_heard():
    rclpy.init()
    driver = rclpy.create_node("driver")
    camera = CameraModel(1280, 720, pinhole_matrix(1280, 720, 60.0))
    driver.create_publisher(CameraInfo, "/drocap/camera_info", KEPT_QOS).publish(
        camera_info_to_ros(header_at(time.time_ns(), "camera"), camera)
    )
    node = MavlinkBridgeNode(MavlinkBridgeConfig(url=f"udpin:127.0.0.1:{free_udp_port()}"))
    try:
        end = time.monotonic() + 5.0
        while not node.controller.calibrated and time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
        assert node.controller.calibrated
    finally:
        node.close()
        node.destroy_node()
        driver.destroy_node()
        rclpy.try_shutdown()


def test_an_error_in_the_control_loop_holds_the_vehicle_at_once(node, monkeypatch):
    sent = []
    monkeypatch.setattr(node._watchdog, "_send", sent.append)
    node._watchdog.kick(node.now_s(), FallbackCommands("hold", "hold mode", lambda: True, lambda: False))
    monkeypatch.setattr(node.controller, "step", lambda now_ns, now_s: 1 / 0)
    node._control()
    assert sent == ["hold"]
    assert isinstance(node.failure, ZeroDivisionError)
