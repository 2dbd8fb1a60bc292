"""Pictures within a process."""

import contextlib
import threading
import time

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from drocap_ros.bringup import free_domain
from drocap_ros.errors import InputError
from drocap_ros.nodes.image_ingest import ImageIngestNode
from drocap_ros.nodes.initializer import InitializerNode
from drocap_ros.perception.jpeg import encode_jpeg
from drocap_ros.perception.perception_config import ImageIngestConfig
from drocap_ros.recording.pictures import image_from_message
from drocap_ros.ros.conversions import compressed_image_to_ros, header_at, stamp_from_ros
from drocap_ros.ros.image_transport import Picture, PictureInput, PictureReader
from drocap_ros.ros.topics import IMAGE_RECORDING_QOS, TOPICS


@pytest.fixture
def context():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        yield context
        context.try_shutdown()


@pytest.fixture
def pictures(tmp_path):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(5)]
    for i, image in enumerate(images):
        cv2.imwrite(str(tmp_path / f"{i}.png"), image)
    return tmp_path, images


@contextlib.contextmanager
def spinning(context, *nodes):
    executor = SingleThreadedExecutor(context=context)
    for node in nodes:
        executor.add_node(node)

    def until(condition, rounds=400):
        for _ in range(rounds):
            if condition():
                return
            executor.spin_once(timeout_sec=0.05)
        pytest.fail("it did not come")

    try:
        yield until
    finally:
        for node in nodes:
            node.close()
        executor.shutdown()
        for node in nodes:
            node.destroy_node()


def test_an_array_arrives_as_it_was_and_jpeg_comes_from_elsewhere_only(context, pictures):
    folder, images = pictures
    config = ImageIngestConfig(source=str(folder), loop=True, folder_rate_hz=50.0)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)
    got = []

    def decode(message):
        return image_from_message(message, compressed=True)

    source = PictureInput(reader, lambda header, image: got.append((header, image)), decode, depth=1)
    with spinning(context, camera, reader) as until:
        until(lambda: len(got) >= 5)
        # Noise does not survive JPEG: what arrived was never encoded.
        assert all(any(np.array_equal(image, original) for original in images) for _, image in got)
        assert camera.count_publishers("/drocap/image/compressed") == 1
        assert reader.count_subscribers("/drocap/image/compressed") == 0

        # The camera's node goes; another process publishes.
        camera.close()
        got.clear()
        until(lambda: reader.count_subscribers("/drocap/image/compressed") == 1)
        other = reader.create_publisher(TOPICS["image/compressed"].message, "image/compressed", IMAGE_RECORDING_QOS)
        until(lambda: other.get_subscription_count() == 1)
        flat = np.full((48, 64, 3), 90, np.uint8)
        other.publish(compressed_image_to_ros(header_at(10**18, "c"), encode_jpeg(flat)))
        until(lambda: got)
        assert stamp_from_ros(got[-1][0].stamp) == 10**18
        assert np.abs(got[-1][1].astype(int) - 90).max() <= 2
        source.close()


def test_a_recorder_gets_jpeg_while_a_reader_gets_arrays(context, pictures):
    folder, _ = pictures
    config = ImageIngestConfig(source=str(folder), loop=True, folder_rate_hz=50.0)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)
    arrays, jpegs = [], []
    PictureInput(reader, lambda header, _: arrays.append(stamp_from_ros(header.stamp)), lambda _: None, depth=1)
    kind = TOPICS["image/compressed"].message
    reader.create_subscription(kind, "image/compressed", jpegs.append, IMAGE_RECORDING_QOS)
    with spinning(context, camera, reader) as until:
        until(lambda: len(jpegs) > 10 and len(arrays) > 10)
    shared = {stamp_from_ros(m.header.stamp) for m in jpegs} & set(arrays)
    assert len(shared) > 5
    assert bytes(jpegs[0].data[:2]) == b"\xff\xd8"


def test_a_reader_that_is_busy_misses_the_oldest_and_knows_how_many():
    reader = PictureReader(depth=2)
    sent = [Picture(header_at(i, "c"), np.zeros((1, 1, 3), np.uint8)) for i in range(5)]
    for picture in sent:
        reader.put(picture)
    assert not reader.settle(timeout_s=0.0)
    assert reader.take() == (sent[3], 3, True, 1)
    assert reader.take() == (sent[4], 0, True, 0)
    assert not reader.settle(timeout_s=0.0)  # the last is still being worked on
    reader.close()
    assert reader.take() is None
    assert reader.settle(timeout_s=0.0)


def test_a_reader_that_waits_gets_the_next_picture():
    reader = PictureReader(depth=2)
    sent = Picture(header_at(1, "c"), np.zeros((1, 1, 3), np.uint8))
    threading.Timer(0.1, reader.put, [sent]).start()
    assert reader.take() == (sent, 0, False, 0)


def test_what_goes_wrong_with_a_picture_comes_out_of_the_nodes_thread(context, pictures):
    config = ImageIngestConfig(source=str(pictures[0]), loop=True, folder_rate_hz=50.0)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)

    def take(header, image):
        raise ZeroDivisionError("of the test")

    source = PictureInput(reader, take, lambda _: None, depth=1)
    with spinning(context, camera, reader) as until:
        with pytest.raises(ZeroDivisionError, match="of the test"):
            until(lambda: False)
        source.close()


def test_a_picture_that_cannot_be_used_is_counted_and_the_next_one_is_taken(context, pictures):
    config = ImageIngestConfig(source=str(pictures[0]), loop=True, folder_rate_hz=50.0)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)
    taken = []

    def take(header, image):
        taken.append(image)
        if len(taken) == 2:
            raise InputError("image: expected light, got darkness")

    source = PictureInput(reader, take, lambda _: None, depth=1)
    with spinning(context, camera, reader) as until:
        until(lambda: len(taken) > 4)
        source.close()
    assert reader.counters["messages refused"] == 1


@pytest.mark.parametrize(("work_s", "waited"), [(0.0, False), (0.06, True)])
def test_a_reader_that_is_too_slow_knows_that_pictures_waited(context, pictures, work_s, waited):
    config = ImageIngestConfig(source=str(pictures[0]), loop=True, folder_rate_hz=20.0)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)
    told = []

    def take(header, image):
        told.append(source.waited)
        time.sleep(work_s)

    source = PictureInput(reader, take, lambda message: image_from_message(message, compressed=True), depth=2)
    with spinning(context, camera, reader) as until:
        until(lambda: len(told) >= 12)
    assert np.mean(told[4:12]) == waited
