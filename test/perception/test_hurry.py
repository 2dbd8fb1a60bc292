"""What the estimator leaves out when the next image waits already."""

import cv2
import numpy as np
import pytest

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.perception_config import PoseEstimatorConfig


@pytest.mark.parametrize("hurry", [0, 1])
def test_a_subject_shown_dimly_gets_a_second_look_only_where_there_is_time(shared, monkeypatch, hurry):
    estimator = PoseEstimator(shared / "models")
    look, windows = estimator.detector.detect, []
    monkeypatch.setattr(estimator.detector, "detect", lambda image, w, *a: windows.append(w) or look(image, w, *a))
    clear = cv2.imread(str(shared / "media" / "skier.jpg"))
    dim = cv2.GaussianBlur(clear // 12, (0, 0), 9)
    for i in range(3):
        assert estimator.process(clear, i * 33_000_000).track_id == 1
    windows.clear()
    observation = estimator.process(dim, 3 * 33_000_000, hurry=hurry)
    assert observation.track_id == 1
    assert len(windows) == (1 if hurry else 2)
    assert None not in windows  # near the subject, not over the whole


def counted(monkeypatch, owner, name):
    calls, original = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *a: calls.append(1) or original(*a))
    return calls


@pytest.mark.parametrize(
    ("hurry", "expected"),
    [  # D: detection and pose, P: pose alone, f: keypoints carried on
        (0, "DDDDDDDD"),
        (1, "PfDfPfDfPf"),
        (3, "PfffPfffDfffPfffPfffD"),
    ],
)
def test_in_a_hurry_a_clear_subject_is_detected_when_due_and_carried_on_in_between(
    shared, monkeypatch, hurry, expected
):
    estimator = PoseEstimator(shared / "models", PoseEstimatorConfig(detect_every_s=0.1))
    image = cv2.imread(str(shared / "media" / "skier.jpg"))
    first = estimator.process(image, 0)
    assert first.track_id == 1
    detections = counted(monkeypatch, estimator.detector, "detect")
    poses = counted(monkeypatch, estimator.pose_model, "estimate")
    seen = ""
    for i in range(1, len(expected) + 1):
        estimator._margins = None  # as with somebody near: the box cannot be carried on from the joints
        before = len(detections), len(poses)
        observation = estimator.process(image, i * 33_333_333, hurry=hurry)
        assert observation.track_id == 1
        assert observation.stamp_ns == i * 33_333_333
        assert observation.confidence.mean() > 0.8
        size = (first.roi[2:] - first.roi[:2]).max()
        assert np.nanmax(np.abs(observation.keypoints - first.keypoints)) < 0.03 * size
        work = len(detections) - before[0], len(poses) - before[1]
        seen += {(1, 1): "D", (0, 1): "P", (0, 0): "f"}[work]
        assert estimator.carried == (seen[-1] == "f")
    assert seen == expected


@pytest.mark.parametrize(
    ("hurry", "expected"),
    [(1, [0, 1, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), (3, [0] * 3 + [1] + [0] * 6 + [1] + [0] * 12 + [1])],
)
def test_in_a_hurry_joints_that_nobody_sees_are_looked_for_ever_more_rarely(shared, monkeypatch, hurry, expected):
    estimator = PoseEstimator(shared / "models")
    clear = cv2.imread(str(shared / "media" / "skier.jpg"))
    for i in range(3):
        assert estimator.process(clear, i * 33_000_000).track_id == 1
    dark = np.zeros_like(clear)
    estimator.process(dark, 99_000_000)
    looks = counted(monkeypatch, estimator.pose_model, "estimate")
    seen = []
    for i in range(4, 4 + len(expected)):
        before = len(looks)
        observation = estimator.process(dark, i * 33_000_000, hurry=hurry)
        assert observation.track_id == 1
        seen.append(len(looks) - before)
        assert seen[-1] or np.isnan(observation.keypoints).all()
    assert seen == expected


def test_in_a_hurry_one_window_an_image_and_each_has_its_turn(shared, monkeypatch):
    estimator = PoseEstimator(shared / "models")
    look, windows = estimator.detector.detect, []
    monkeypatch.setattr(estimator.detector, "detect", lambda image, w, *a: windows.append(w) or look(image, w, *a))
    nobody = np.full((720, 1280, 3), 90, np.uint8)
    for i in range(8):
        assert estimator.process(nobody, i * 33_000_000, hurry=1).track_id == 0
        assert len(windows) == i + 1
    assert windows.count(None) == 4
    assert len(set(windows)) > 2  # tiles, one after the other


def test_in_a_hurry_throughout_the_subject_is_kept_through_a_somersault(shared, monkeypatch):
    video = cv2.VideoCapture(str(shared / "media" / "outdoor_walk.mp4"))
    images = []
    for i in range(212):  # the jump's end
        image = video.read()[1]
        if i >= 100:
            images.append(cv2.resize(image, (1280, 720), interpolation=cv2.INTER_AREA))
    boxes, work = {}, {}
    for hurry in (0, 1, 3):
        estimator = PoseEstimator(shared / "models")
        networks = ((estimator.detector, "detect"), (estimator.pose_model, "estimate"))
        runs = [counted(monkeypatch, *network) for network in networks]
        observations = [estimator.process(im, i * 33_333_333, hurry=hurry) for i, im in enumerate(images)]
        assert {o.track_id for o in observations} == {1}
        boxes[hurry] = np.array([o.roi for o in observations])
        work[hurry] = sum(map(len, runs))
    assert work[1] < 0.6 * work[0]
    assert work[3] < 0.45 * work[0]
    for hurry in (1, 3):
        low = np.maximum(boxes[0][:, :2], boxes[hurry][:, :2])
        high = np.minimum(boxes[0][:, 2:], boxes[hurry][:, 2:])
        both = np.prod(np.clip(high - low, 0, None), axis=1)
        either = sum(np.prod(boxes[k][:, 2:] - boxes[k][:, :2], axis=1) for k in (0, hurry)) - both
        assert (both / either > 0.3).mean() > 0.9


def test_in_a_hurry_what_the_network_makes_of_an_empty_place_is_not_carried_on(shared, monkeypatch):
    estimator = PoseEstimator(shared / "models")
    image = cv2.imread(str(shared / "media" / "skier.jpg"))
    for i in range(4):
        assert estimator.process(image, i * 33_333_333, hurry=3).track_id == 1
    assert estimator.carried
    # The drone is thrown round: no detection where the person was, and joints that the network itself doubts.
    nobody = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32))
    monkeypatch.setattr(estimator.detector, "detect", lambda *_: nobody)
    joints = estimator._in_our_joints
    monkeypatch.setattr(estimator, "_in_our_joints", lambda k: (*(j := joints(k))[:2], 0.4 * j[2]))
    carried = []
    for i in range(4, 19):
        estimator.process(image, i * 33_333_333, hurry=3)
        carried.append(estimator.carried)
    assert not any(carried[3:])  # three pictures may still come from what was seen well
