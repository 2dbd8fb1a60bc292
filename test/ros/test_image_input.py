"""Images of ``image/compressed``: queue, decoding, drops."""

import contextlib
import threading
import time

import cv2
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CompressedImage

from drocap_ros.errors import InputError
from drocap_ros.nodes.image_ingest import ImageIngestNode
from drocap_ros.nodes.initializer import InitializerNode
from drocap_ros.nodes.pose_estimator import ImageInput, ImageQueue
from drocap_ros.perception.sources.base import ImageIngestConfig
from drocap_ros.recording.image_messages import image_from_message
from drocap_ros.ros.conversions import header_at
from drocap_ros.ros.diagnostics import Key


@pytest.fixture
def folder(tmp_path):
    for i in range(5):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((48, 64, 3), 40 * i, np.uint8))
    return tmp_path


@contextlib.contextmanager
def reading(context, folder, process, rate_hz=50.0, depth=1):
    """A camera, a node that reads it, and a function that spins both until a condition holds."""
    config = ImageIngestConfig(source=str(folder), loop=True, folder_rate_hz=rate_hz)
    camera = ImageIngestNode(config, context=context, use_global_arguments=False)
    reader = InitializerNode(context=context, use_global_arguments=False)
    source = ImageInput(reader, process, depth)
    executor = SingleThreadedExecutor(context=context)
    for node in (camera, reader):
        executor.add_node(node)

    def until(condition):
        end = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.05)
            if reader.failure is not None:
                raise reader.failure

    try:
        yield reader, until
    finally:
        source.close()
        for node in (camera, reader):
            node.close()
        executor.shutdown()
        for node in (camera, reader):
            node.destroy_node()


def test_images_arrive(context, folder):
    samples = []
    with reading(context, folder, samples.append) as (_, until):
        until(lambda: len(samples) >= 5)
    images = [image_from_message(sample.message, compressed=True) for sample in samples]
    levels = {round(float(image.mean()) / 40) for image in images}
    assert images[0].shape == (48, 64, 3)
    assert levels <= {0, 1, 2, 3, 4}
    assert len(levels) >= 3


def numbered(count):
    return [CompressedImage(header=header_at(i, "c")) for i in range(count)]


def test_full_queue_drops_the_oldest_image_and_counts_it():
    queue, images = ImageQueue(depth=2), numbered(5)
    for image in images:
        queue.put(image)
    assert not queue.wait_idle(timeout_s=0.0)
    assert queue.take() == (images[3], 3, True, 1)
    assert queue.take() == (images[4], 0, True, 0)
    assert not queue.wait_idle(timeout_s=0.0)  # the last one is still being processed
    queue.close()
    assert queue.take() is None
    assert queue.wait_idle(timeout_s=0.0)


def test_image_that_did_not_wait_is_marked_so():
    queue, (image,) = ImageQueue(depth=2), numbered(1)
    threading.Timer(0.1, queue.put, [image]).start()
    assert queue.take() == (image, 0, False, 0)


def test_error_of_the_processing_thread_reaches_the_node(context, folder):
    def fail(_):
        raise ZeroDivisionError("of the test")

    with (
        pytest.raises(ZeroDivisionError, match="of the test"),
        reading(context, folder, fail) as (_, until),
    ):
        until(lambda: False)


def test_refused_image_is_counted_and_the_next_one_processed(context, folder):
    taken = []

    def process(sample):
        taken.append(sample)
        if len(taken) == 2:
            raise InputError("image: expected light, got darkness")

    with reading(context, folder, process) as (reader, until):
        until(lambda: len(taken) > 4)
    assert reader.counters[Key.MESSAGES_REFUSED] == 1


@pytest.mark.parametrize(("work_s", "waited"), [(0.0, False), (0.06, True)])
def test_images_wait_only_for_slow_processing(context, folder, work_s, waited):
    found = []

    def process(sample):
        found.append(sample.waited)
        time.sleep(work_s)

    with reading(context, folder, process, rate_hz=20.0, depth=2) as (_, until):
        until(lambda: len(found) >= 12)
    assert np.mean(found[4:12]) == waited
