"""Load shedding in the estimator, with the shipped simulation networks on rendered images."""

import cv2
import numpy as np
import pytest
from rendered_person import rendered_images

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.load_models import SIMULATION, models_folder
from drocap_ros.perception.load_shedding import Follower, KeypointFlow
from drocap_ros.perception.sources.base import Frame
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

pytest.importorskip("onnxruntime")

STEP_NS = 33_333_333


@pytest.fixture(scope="module")
def images():
    """Three seconds of a moving person."""
    return rendered_images(90)


@pytest.fixture
def estimator():
    return PoseEstimator(models_folder(SIMULATION), PoseEstimatorConfig(detect_every_s=0.1))


def grainy(image, number):
    """The image with a noise of its own: one that is repeated bit for bit shows nothing new."""
    out = image.copy()
    out[0, 0] = number
    return out


def counted(monkeypatch, owner, name):
    calls, original = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *a: calls.append(a) or original(*a))
    return calls


def iou_per_image(boxes, others):
    low, high = np.maximum(boxes[:, :2], others[:, :2]), np.minimum(boxes[:, 2:], others[:, 2:])
    both = np.prod(np.clip(high - low, 0, None), axis=1)
    return both / (sum(np.prod(b[:, 2:] - b[:, :2], axis=1) for b in (boxes, others)) - both)


@pytest.mark.parametrize("load_level", [0, 1])
def test_second_pass_runs_only_without_load_shedding(estimator, images, monkeypatch, load_level):
    for i in range(3):
        assert estimator.process(grainy(images[0], i), i * STEP_NS).track_id == 1
    detections = counted(monkeypatch, estimator.detector, "detect")
    dim = cv2.GaussianBlur(images[0] // 12, (0, 0), 9)
    assert estimator.process(dim, 3 * STEP_NS, load_level=load_level).track_id == 1
    assert len(detections) == (1 if load_level else 2)
    assert None not in [window for _, window, *_ in detections]  # near the subject, not the whole image


@pytest.mark.parametrize(
    ("load_level", "expected"),
    [  # D: detection and pose network, P: pose network, f: optical flow
        (0, "DDDDDDDD"),
        (1, "PfDfPfDfPf"),
        (3, "PfffPfffDfffPfffPfffD"),
    ],
)
def test_clear_subject_is_detected_when_due_and_propagated_in_between(
    estimator, images, monkeypatch, load_level, expected
):
    first = estimator.process(images[0], 0)
    assert first.track_id == 1
    detections = counted(monkeypatch, estimator.detector, "detect")
    poses = counted(monkeypatch, estimator.pose_model, "estimate")
    work = ""
    for i in range(1, len(expected) + 1):
        monkeypatch.setattr(estimator.search, "isolated", lambda *_: False)
        before = len(detections), len(poses)
        observation = estimator.process(grainy(images[0], i), i * STEP_NS, load_level=load_level)
        assert observation.track_id == 1
        assert observation.stamp_ns == i * STEP_NS
        assert observation.confidence.mean() > 0.8
        size = (first.roi[2:] - first.roi[:2]).max()
        assert np.nanmax(np.abs(observation.keypoints - first.keypoints)) < 0.03 * size
        work += {(1, 1): "D", (0, 1): "P", (0, 0): "f"}[len(detections) - before[0], len(poses) - before[1]]
        assert estimator.propagated == (work[-1] == "f")
    assert work == expected


def test_isolated_subject_is_propagated_by_the_pose_network_without_load_shedding(estimator, images, monkeypatch):
    detections = counted(monkeypatch, estimator.detector, "detect")
    observations = [estimator.process(image, i * STEP_NS) for i, image in enumerate(images[:30])]
    assert {o.track_id for o in observations} == {1}
    assert len(detections) < 20


def test_subject_is_updated_between_the_rarer_detections_of_load_shedding(estimator, images, monkeypatch):
    updates = counted(monkeypatch, estimator.tracker, "propagate")
    ages_s = []
    for i, image in enumerate(images[:30]):
        before = len(updates)
        estimator.process(image, i * STEP_NS, load_level=3)
        ages_s += [(i * STEP_NS - estimator._detected_ns) * 1e-9] * (len(updates) - before)
    assert max(ages_s, default=0.0) > 0.2  # at a stale place the tracker would extrapolate the last speed


@pytest.mark.parametrize(
    ("load_level", "expected"),
    [(1, [0, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), (3, [0] * 3 + [1] + [0] * 6 + [1] + [0] * 12 + [1])],
)
def test_pose_network_pauses_double_while_it_finds_no_person(estimator, images, monkeypatch, load_level, expected):
    for i in range(3):
        assert estimator.process(grainy(images[0], i), i * STEP_NS).track_id == 1
    dark = np.zeros_like(images[0])
    estimator.process(dark, 3 * STEP_NS)
    poses = counted(monkeypatch, estimator.pose_model, "estimate")
    runs = []
    for i in range(4, 4 + len(expected)):
        before = len(poses)
        observation = estimator.process(dark, i * STEP_NS, load_level=load_level)
        assert observation.track_id == 1
        runs.append(len(poses) - before)
        assert runs[-1] or np.isnan(observation.keypoints).all()
    assert runs == expected


def test_a_repeated_picture_gives_the_same_keypoints_bit_for_bit(estimator, images):
    estimator.process(images[0], 0)
    seen = estimator.process(images[1], STEP_NS)
    for i in range(2, 8):
        again = estimator.process(images[1], i * STEP_NS)
        assert again.stamp_ns == i * STEP_NS
        assert np.array_equal(again.keypoints, seen.keypoints, equal_nan=True)
        assert np.array_equal(again.roi, seen.roi)
        assert again.background is None  # points that stand still would say that the camera does
    assert not np.array_equal(estimator.process(images[2], 8 * STEP_NS).keypoints, seen.keypoints)
    # Stamps that go back restart the tracker, and the points of the scene.
    restarted = estimator.process(images[2], 0)
    assert restarted.track_id == 2
    assert len(restarted.background) > 10
    assert not np.isin(restarted.background.track, seen.background.track).any()


def test_search_takes_one_window_per_image_in_turn(estimator, monkeypatch):
    detections = counted(monkeypatch, estimator.detector, "detect")
    empty = np.full((720, 1280, 3), 90, np.uint8)
    for i in range(8):
        assert estimator.process(empty, i * STEP_NS, load_level=1).track_id == 0
        assert len(detections) == i + 1
    windows = [window for _, window, *_ in detections]
    assert windows.count(None) == 4
    assert len(set(windows)) > 2  # tiles, one after the other


def test_shedding_halves_the_network_runs_and_keeps_the_subject(images, monkeypatch):
    boxes, runs = {}, {}
    for load_level in (0, 1, 3):
        estimator = PoseEstimator(models_folder(SIMULATION))
        networks = ((estimator.detector, "detect"), (estimator.pose_model, "estimate"))
        calls = [counted(monkeypatch, *network) for network in networks]
        observations = [estimator.process(im, i * STEP_NS, load_level=load_level) for i, im in enumerate(images)]
        assert {o.track_id for o in observations} == {1}
        boxes[load_level] = np.array([o.roi for o in observations])
        runs[load_level] = sum(map(len, calls))
    assert runs[1] < 0.6 * runs[0]
    assert runs[3] < 0.45 * runs[0]
    for load_level in (1, 3):
        assert (iou_per_image(boxes[0], boxes[load_level]) > 0.3).mean() > 0.8


def test_doubtful_keypoints_without_a_detection_are_not_propagated(estimator, images, monkeypatch):
    for i in range(4):
        assert estimator.process(grainy(images[0], i), i * STEP_NS, load_level=3).track_id == 1
    assert estimator.propagated
    nobody = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32))
    monkeypatch.setattr(estimator.detector, "detect", lambda *_: nobody)
    body, estimate = estimator.body, estimator.body.estimate
    monkeypatch.setattr(body, "estimate", lambda *a: (pose := estimate(*a))._replace(confidence=0.4 * pose.confidence))
    propagated = []
    for i in range(4, 19):
        estimator.process(grainy(images[0], i), i * STEP_NS, load_level=3)
        propagated.append(estimator.propagated)
    assert not any(propagated[3:])  # the first three may still follow the last certain keypoints


def test_subject_survives_a_somersault_under_constant_shedding(shared):
    video = cv2.VideoCapture(str(shared / "media" / "outdoor_walk.mp4"))
    images = [cv2.resize(video.read()[1], (1280, 720), interpolation=cv2.INTER_AREA) for _ in range(212)][100:]
    boxes = {}
    for load_level in (0, 3):
        estimator = PoseEstimator(shared / "models")
        observations = [estimator.process(im, i * STEP_NS, load_level=load_level) for i, im in enumerate(images)]
        assert {o.track_id for o in observations} == {1}
        boxes[load_level] = np.array([o.roi for o in observations])
    assert (iou_per_image(boxes[0], boxes[3]) > 0.3).mean() > 0.9


def test_a_box_that_moves_out_of_the_image_ends_at_its_border():
    noise = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 3) * 4  # a texture to follow
    joints = np.stack([np.linspace(30, 110, 15), np.linspace(60, 200, 15)], axis=1).astype(np.float32)
    before = PoseObservation(
        0, 1, (320, 240), roi=np.array([2, 40, 122, 220], np.float32), keypoints=joints,
        covariance=np.ones((15, 3), np.float32), confidence=np.ones(15, np.float32),
    )  # fmt: skip
    flow = KeypointFlow()
    flow.start(image, before)
    after = flow.propagate(np.roll(image, -6, axis=1), STEP_NS)
    assert np.nanmedian(after.keypoints[:, 0] - joints[:, 0]) == pytest.approx(-6.0, abs=0.5)
    assert after.roi[0] == 0.0
    assert after.roi[2] == pytest.approx(116.0, abs=0.5)


@pytest.mark.parametrize("late", [2, 4, 8])
def test_images_are_followed_while_the_networks_look_at_one_of_those_before(estimator, images, late):
    """Each image has keypoints at once, with covariances that grow until the networks' come."""
    clear = [estimator.process(image, i * STEP_NS) for i, image in enumerate(images[:60])]
    follower, looked, seen = Follower(estimator.hand_over()), 0, []
    for i, image in enumerate(images[:60]):
        if i >= looked + late:  # the networks are done with that one, and look at the newest
            follower.correct(clear[looked])
            looked = i
        seen.append(follower.follow(Frame(i * STEP_NS, image)))
    assert seen[: late + 1] == [None] * late + [seen[late]]
    assert seen[late:].count(None) <= 2  # where most joints moved too far
    for now, true in zip(seen[late:], clear[late:60], strict=True):
        if now is None:
            continue
        assert now.stamp_ns == true.stamp_ns
        size = (true.roi[2:] - true.roi[:2]).max()
        off = np.linalg.norm(now.keypoints - true.keypoints, axis=1) / size
        assert np.nanmedian(off) < 0.04
        assert np.nanmedian(now.covariance[:, 0]) > np.nanmedian(true.covariance[:, 0])


def test_keypoints_of_another_stream_are_not_taken_for_those_of_an_image_that_was_followed(estimator, images):
    follower = Follower(estimator.hand_over())
    seen = estimator.process(images[0], 0)
    assert follower.follow(Frame(STEP_NS, images[1])) is None
    follower.correct(seen)
    assert follower.follow(Frame(2 * STEP_NS, images[2])) is None


def test_where_the_networks_find_no_keypoints_that_holds_until_they_look_again(estimator, images):
    follower = Follower(estimator.hand_over())
    for i in range(6):
        follower.follow(Frame(i * STEP_NS, images[i]))
    follower.correct(PoseObservation(STEP_NS, 0, (1280, 720)))
    nobody = follower.follow(Frame(6 * STEP_NS, images[6]))
    assert (nobody.stamp_ns, nobody.track_id, len(nobody.keypoints)) == (6 * STEP_NS, 0, 0)
    follower.correct(estimator.process(images[4], 4 * STEP_NS))
    assert np.isfinite(follower.follow(Frame(7 * STEP_NS, images[7])).keypoints).any()


def test_followed_keypoints_of_a_picture_that_stands_still_repeat_bit_for_bit(estimator, images):
    follower, first = Follower(estimator.hand_over()), estimator.process(images[0], 0)
    follower.follow(Frame(0, images[0]))
    follower.correct(first)
    for i in range(1, 9):
        again = follower.follow(Frame(i * STEP_NS, images[0]))
        assert again.stamp_ns == i * STEP_NS
        assert np.array_equal(again.keypoints, first.keypoints, equal_nan=True)


@pytest.mark.parametrize("rate_hz", [12.5, 30.0, 90.0])
def test_an_image_has_no_keypoints_where_the_networks_have_looked_at_none_for_long(estimator, images, rate_hz):
    step_ns = round(1e9 / rate_hz)
    follower, first = Follower(estimator.hand_over()), estimator.process(images[0], 0)
    follower.follow(Frame(0, images[0]))
    follower.correct(first)
    assert first.has_subject
    for n in range(1, 150):
        followed = follower.follow(Frame(n * step_ns, grainy(images[0], n)))
        assert (followed is not None) == (n * step_ns <= 800_000_000)
