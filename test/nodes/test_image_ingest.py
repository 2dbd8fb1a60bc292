"""Every kind of source of ``image_ingest``."""

import os
import subprocess
import sys
from array import array

import cv2
import numpy as np
import pytest
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from drocap_ros.bringup import bringup
from drocap_ros.config import DrocapConfig
from drocap_ros.errors import InputError
from drocap_ros.ros.conversions import header_at, stamp_from_ros
from drocap_ros.ros.diagnostics import Key
from drocap_ros.ros.topics import TOPICS


def picture(value=60):
    image = np.full((120, 160, 3), value, np.uint8)
    image[30:90, 40:100] = (200, 120, 40)
    return image


@pytest.fixture
def folder(tmp_path):
    for i in range(12):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), picture(20 + 10 * i))
    return tmp_path


def run(config, until, publish=None, kind=None, topic=None):
    """Bring the node up, publish messages to it if asked, and collect its messages until a condition holds."""
    images, infos, reports = [], [], []
    with bringup(DrocapConfig().replace("image_ingest", **config), ["image_ingest"]) as graph:
        for name, into in (("image/compressed", images), ("camera_info", infos), ("/diagnostics", reports)):
            graph.node.create_subscription(TOPICS[name].message, name, into.append, TOPICS[name].qos)
        if publish is not None:
            publisher = graph.node.create_publisher(kind, topic, qos_profile_sensor_data)
            graph.wait_until(publisher.get_subscription_count, 20, "the node to listen")
            while not until(images, infos, reports):
                for message in publish:
                    publisher.publish(message)
                    graph.spin_for(0.05)
        graph.wait_until(lambda: until(images, infos, reports), 30)
    return images, infos, reports


def values(reports):
    return {v.key: v.value for m in reports for v in m.status[0].values}


def test_stamps_of_a_looped_folder_increase_and_the_camera_is_published(folder):
    config = {"source": str(folder), "loop": True, "folder_rate_hz": 60.0, "horizontal_fov_deg": 90.0}
    images, infos, _ = run(config, lambda i, _n, _r: len(i) >= 30)
    stamps = [stamp_from_ros(m.header.stamp) for m in images]
    assert np.all(np.diff(stamps) > 0)
    # Best effort may lose one, but no jump at the seam of the loop.
    assert np.diff(stamps).max() < 4e9 / 60
    assert infos[0].k[0] == pytest.approx(80.0)
    assert cv2.imdecode(np.frombuffer(images[0].data, np.uint8), 1).shape == (120, 160, 3)


def test_max_rate_skips_images_and_counts_them(folder):
    config = {"source": str(folder), "loop": True, "folder_rate_hz": 60.0, "max_rate_hz": 20.0}
    images, _, reports = run(config, lambda i, _n, r: len(i) >= 20 and Key.IMAGES_SKIPPED in values(r))
    stamps = np.array([stamp_from_ros(m.header.stamp) for m in images])
    assert np.diff(stamps).min() >= 0.049e9
    assert int(values(reports)[Key.IMAGES_SKIPPED]) > 10


def raw_image(stamp_ns, data, encoding="bgr8"):
    height, width = data.shape[:2]
    return Image(
        header=header_at(stamp_ns, "nose_camera"),
        height=height,
        width=width,
        encoding=encoding,
        step=data.nbytes // height,
        data=array("B", np.ascontiguousarray(data).tobytes()),
    )


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_image_topic_keeps_its_stamps_and_colours(encoding):
    image = picture()
    data = {"rgb8": image[..., ::-1], "bgr8": image, "mono8": image[..., 1]}[encoding]
    messages = [raw_image(10**9 * (5 + i), data, encoding) for i in range(3)]
    config = {"source": "topic:/front/image_raw"}
    images, _, _ = run(config, lambda i, _n, _r: len(i) >= 3, messages, Image, "/front/image_raw")
    assert {m.header.frame_id for m in images} == {"nose_camera"}
    assert {stamp_from_ros(m.header.stamp) for m in images} <= {10**9 * (5 + i) for i in range(3)}
    decoded = cv2.imdecode(np.frombuffer(images[0].data, np.uint8), 1).astype(int)
    expected = image if encoding != "mono8" else np.repeat(image[..., 1:2], 3, axis=2)
    assert np.abs(decoded[50:70, 60:80] - expected[50:70, 60:80]).max() < 12


def test_jpeg_topic_is_passed_on_unchanged_and_a_broken_image_is_refused():
    jpeg = cv2.imencode(".jpg", picture())[1].tobytes()
    good = CompressedImage(header=header_at(7, "c"), format="jpeg", data=array("B", jpeg))
    bad = CompressedImage(header=header_at(8, "c"), format="jpeg", data=array("B", b"not a picture"))
    topic = "/front/image_raw/compressed"
    images, _, _ = run(
        {"source": f"topic:{topic}"},
        lambda i, _n, r: i and Key.MESSAGES_REFUSED in values(r),
        [bad, good],
        CompressedImage,
        topic,
    )
    assert bytes(images[0].data) == jpeg


def test_silent_topic_is_reported_within_two_seconds():
    config = {"source": "topic:/nobody/image_raw", "stall_timeout_s": 1.0}
    _, _, reports = run(config, lambda _i, _n, r: any("no image" in m.status[0].message for m in r))
    assert "check the camera" in reports[-1].status[0].message


def test_camera_info_follows_the_size_of_the_images():
    messages = [raw_image(10**9 * (5 + i), np.repeat(picture(), 1 + i, axis=1).repeat(1 + i, axis=0)) for i in range(2)]
    config = {"source": "topic:/front/image_raw", "horizontal_fov_deg": 90.0}
    _, infos, _ = run(config, lambda _i, n, _r: len({m.width for m in n}) == 2, messages, Image, "/front/image_raw")
    assert {(m.width, m.height, round(m.k[0])) for m in infos} == {(160, 120, 80), (320, 240, 160)}


@pytest.mark.parametrize("name", ["", "bad name/compressed", "/front//image_raw", "{lens}/image_raw", "front/"])
def test_a_topic_that_ros_does_not_allow_is_refused_in_one_line(name):
    config = DrocapConfig().replace("image_ingest", source=f"topic:{name}")
    refusal = pytest.raises(InputError, match=r"^source: expected topic:NAME .*; correct the name$")
    with refusal as caught, bringup(config, ["image_ingest"], timeout_s=5.0):
        pass
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("qos", "reliable"), [(QoSProfile(depth=10), True), (qos_profile_sensor_data, False)])
def test_the_subscription_is_as_reliable_as_the_driver(qos, reliable):
    topic = "/front/image_raw"
    with bringup(DrocapConfig().replace("image_ingest", source=f"topic:{topic}"), ["image_ingest"]) as graph:
        other = graph.node.create_publisher(Image, topic, qos_profile_sensor_data if reliable else QoSProfile(depth=10))
        graph.wait_until(other.get_subscription_count, 10, "the node to listen")
        graph.node.destroy_publisher(other)
        # Another driver takes its place.
        publisher = graph.node.create_publisher(Image, topic, qos)

        def offers():
            return {info.qos_profile.reliability.name for info in graph.node.get_subscriptions_info_by_topic(topic)}

        graph.wait_until(lambda: offers() == {"RELIABLE" if reliable else "BEST_EFFORT"}, 10, "the node to adapt")
        graph.wait_until(publisher.get_subscription_count, 10, "the node to listen")


@pytest.mark.parametrize("kind", [CompressedImage, CameraInfo])
def test_type_of_the_topic_is_that_of_its_publisher(kind):
    topic, reports = "/front/jpeg", []
    with bringup(DrocapConfig().replace("image_ingest", source=f"topic:{topic}"), ["image_ingest"]) as graph:
        publisher = graph.node.create_publisher(kind, topic, 10)
        entry = TOPICS["/diagnostics"]
        graph.node.create_subscription(entry.message, "/diagnostics", reports.append, entry.qos)
        words = "; sensor_msgs/msg/CameraInfo is published there: name an image topic"

        def reported():
            return any(m.status[0].message.endswith(words) for m in reports)

        graph.wait_until(publisher.get_subscription_count if kind is CompressedImage else reported, 10, "the answer")


DRIVER = """
import sys, time, rclpy
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("driver")
publisher = node.create_publisher(Image, "/front/image_raw", 10)
while not publisher.get_subscription_count():
    time.sleep(0.05)
time.sleep(0.5)
image = Image(height=480, width=640, encoding="bgr8", step=1920, data=bytes(921600))
for _ in range(30):
    image.header.stamp = node.get_clock().now().to_msg()
    publisher.publish(image)
    time.sleep(1 / 15)
time.sleep(1.0)
"""


def test_raw_images_of_a_driver_with_the_defaults_of_ros_arrive():
    config = DrocapConfig().replace("image_ingest", source="topic:/front/image_raw", horizontal_fov_deg=60.0)
    with bringup(config, ["image_ingest"], processes=True) as graph:
        infos = []
        entry = TOPICS["camera_info"]
        graph.node.create_subscription(entry.message, "camera_info", infos.append, entry.qos)
        driver = subprocess.Popen(
            [sys.executable, "-c", DRIVER], env={**os.environ, "ROS_DOMAIN_ID": str(graph.domain_id)}
        )
        try:
            graph.wait_until(lambda: driver.poll() is not None, 30, "the driver's end")
        finally:
            driver.kill()
    assert len(infos) >= 28
