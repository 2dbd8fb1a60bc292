"""The pose estimator's node with the networks for simulation."""

import threading
import time
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from sensor_msgs.msg import CompressedImage

from drocap_ros.bringup import bringup, free_domain
from drocap_ros.config import DrocapConfig
from drocap_ros.keypoints import PoseObservation
from drocap_ros.nodes.pose_estimator import ImageSample, PoseEstimatorNode
from drocap_ros.perception.load_shedding import KeypointFlow
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.recording.open_session import open_session
from drocap_ros.recording.session import header_stamp_ns
from drocap_ros.recording.session_tracks import read_pose2d
from drocap_ros.ros.conversions import header_at, stamp_from_ros
from drocap_ros.ros.diagnostics import Key, node_of, of, values_of
from drocap_ros.ros.own_process import LoadShedding
from drocap_ros.ros.topics import TOPICS

MISSED = of(Key.MISSED, "image/compressed")
STEP_NS = 33_333_333


def test_networks_for_simulation_are_named_on_diagnostics():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = PoseEstimatorNode(
            PoseEstimatorConfig(models_dir="simulation"), context=context, use_global_arguments=False
        )
        try:
            assert "for simulation only" in node.details[Key.NETWORKS]
        finally:
            node.close()
            node.destroy_node()
            context.try_shutdown()


@pytest.mark.parametrize(("max_load_level", "sheds"), [(3, True), (0, False)])
def test_estimator_sheds_load_while_images_queue_unless_configured_otherwise(tmp_path, max_load_level, sheds):
    for i in range(8):
        cv2.imwrite(str(tmp_path / f"{i}.jpg"), np.full((90, 120, 3), 20 * i, np.uint8))
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path), loop=True, folder_rate_hz=240.0)
    config = config.replace("pose_estimator", models_dir="simulation", max_load_level=max_load_level)
    values = {}

    def take(message):
        values.update({node_of(status)[1]: values_of(status) for status in message.status})

    def count(key):
        return int(values.get("pose_estimator", {}).get(key, 0))

    with bringup(config, ["image_ingest", "pose_estimator"], processes=True) as graph:
        graph.node.create_subscription(TOPICS["/diagnostics"].message, "/diagnostics", take, TOPICS["/diagnostics"].qos)
        graph.wait_until(lambda: count(MISSED) > 0 and count(Key.IMAGES) > 20, 30, "more images than it can process")
        graph.spin_for(2.0)
        assert (count(Key.IMAGES_SHED) > 0) is sheds


def test_fixed_points_of_the_scene_are_published_and_recorded(tmp_path):
    """A camera pans over a wall: the points move by as much, and the session gives them back bit for bit."""
    (tmp_path / "images").mkdir()
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.normal(120, 30, (40, 90)).clip(0, 255).astype(np.uint8), (900, 400))
    for i in range(10):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), wall[20:380, 10 + 7 * i : 650 + 7 * i])
    config = DrocapConfig().replace("image_ingest", source=str(tmp_path / "images"), folder_rate_hz=5.0, loop=True)
    # The network sees persons in the pattern, and no point lies on a person.
    config = config.replace("pose_estimator", models_dir="simulation", max_load_level=0, detection_threshold=1.0)
    config = config.replace("session_recorder", session_dir=str(tmp_path / "s"))
    heard = []
    with bringup(config, ["image_ingest", "pose_estimator", "session_recorder"]) as graph:
        entry = TOPICS["background"]
        graph.node.create_subscription(entry.message, "background", heard.append, entry.qos)
        graph.wait_until(lambda: len(heard) >= 10, 60, "ten images")
    seen = {"background": {}, "pose2d": {}}
    with open_session(tmp_path / "s") as session:
        for raw, message in session.messages([f"/drocap/{topic}" for topic in seen]):
            seen[raw.topic.split("/")[-1]][header_stamp_ns(message)] = message
        tracks = read_pose2d(session)
    assert len(seen["background"]) >= 10
    steps = []
    for (_, last), (stamp_ns, now) in pairwise(sorted(seen["background"].items())):
        assert now.header.frame_id == seen["pose2d"][stamp_ns].header.frame_id == "camera_optical"
        assert 40 < len(now.track) == len(now.point) / 2
        _, i, j = np.intersect1d(last.track, now.track, return_indices=True)
        points = [np.reshape(message.point, (-1, 2))[k] for message, k in ((last, i), (now, j))]
        steps.append(np.median(points[1] - points[0], axis=0))
    # A busy machine may miss images, and after the last one the pan begins anew.
    assert np.abs(np.round(np.array(steps) / 7) * 7 - steps).max() < 0.3
    assert np.median(steps, axis=0) == pytest.approx([-7, 0], abs=0.3)
    frames = dict(zip(tracks.stamp_ns.tolist(), range(len(tracks)), strict=True))
    for stamp_ns, message in seen["background"].items():
        rows = tracks.background.frame == frames[stamp_ns]
        assert tracks.background.track[rows].tolist() == list(message.track)
        assert tracks.background.point[rows].ravel().tolist() == list(message.point)


class SlowNetworks:
    """Looks at an image when it is let, as slow networks: the subject moves with the picture."""

    def __init__(self):
        self.let, self.busy = threading.Semaphore(0), threading.Event()
        self.looked, self.keypoints, self.levels = [], None, []

    def hand_over(self):
        return KeypointFlow()

    def process(self, image, stamp_ns, roi, load_level, *, looks):
        self.busy.set()
        assert self.let.acquire(timeout=30.0)
        self.busy.clear()
        self.looked.append(stamp_ns)
        self.levels.append((load_level, looks))
        points = np.stack(np.meshgrid([250, 300, 350], [150, 190, 230, 270, 310]), axis=-1).reshape(-1, 2)
        shift = 2.0 * stamp_ns / STEP_NS
        box = np.array([240.0 - shift, 140.0, 360.0 - shift, 320.0], np.float32)
        return PoseObservation(stamp_ns, 1, (image.shape[1], image.shape[0]), roi=box, detection_score=0.9,
                               keypoints=(points - [shift, 0.0]).astype(np.float32),
                               covariance=np.ones((15, 3), np.float32), confidence=np.ones(15, np.float32))  # fmt: skip


@pytest.fixture
def slow_node():
    with free_domain() as domain_id:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain_id)
        node = PoseEstimatorNode(
            PoseEstimatorConfig(models_dir="simulation"), context=context, use_global_arguments=False
        )
        node._estimator, node.published = SlowNetworks(), []
        node._load_shedding = LoadShedding(3)
        node._load_shedding._level = 3  # images queued all the same
        node._beside.took(1.0)
        node._pose2d = SimpleNamespace(publish=node.published.append)
        yield node
        node._estimator.let.release(1000)
        node.close()
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize("slower", [2, 4, 8])
def test_keypoints_of_each_image_are_published_at_once_while_the_networks_look_at_one_before(slow_node, slower):
    """The networks take as long as so many images: no result waits for them, and each is of its own image."""
    wall = cv2.resize(np.random.default_rng(0).integers(0, 255, (36, 100), dtype=np.uint8), (1000, 360))
    networks, published, node = slow_node._estimator, slow_node.published, slow_node
    for i in range(40):
        image = cv2.cvtColor(wall[:, 2 * i : 2 * i + 640], cv2.COLOR_GRAY2BGR)
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        message = CompressedImage(header=header_at(i * STEP_NS, "c"), format="jpeg", data=jpeg.tobytes())
        before = len(published)
        node._on_image(ImageSample(message, 0, waited=False, behind=0))  # returns while the networks are busy
        assert networks.busy.wait(30.0)
        if i > slower:
            assert [stamp_from_ros(m.header.stamp) for m in published[before:]] == [i * STEP_NS]
        if i % slower == slower - 1:
            looked = len(networks.looked)
            networks.let.release()
            until(lambda looked=looked: len(networks.looked) > looked and networks.busy.is_set())
    assert set(networks.levels) == {(3, True)}
    assert np.diff(networks.looked).max() == slower * STEP_NS  # the newest image each time
    stamps = [stamp_from_ros(m.header.stamp) for m in published]
    assert stamps == sorted(set(stamps))
    for message in published[1:]:
        shift = 2.0 * stamp_from_ros(message.header.stamp) / STEP_NS
        seen = np.reshape(message.keypoints, (-1, 2))
        assert np.nanmax(np.abs(seen[:, 0] + shift - np.tile([250, 300, 350], 5))) < 1.0
        assert np.nanmin(np.reshape(message.covariance, (-1, 3))[:, 0]) >= 1.0
    assert len(published) + node.counters[MISSED] == 40
    assert node.counters[Key.IMAGES_PROPAGATED] >= 39 - slower


def until(condition):
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)
