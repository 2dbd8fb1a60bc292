"""What the estimator leaves out when the next image waits already."""

import cv2
import numpy as np
import pytest

from drocap_ros.perception.config import PoseEstimatorConfig
from drocap_ros.perception.estimator import PoseEstimator


@pytest.mark.parametrize("hurried", [False, True])
def test_a_subject_shown_dimly_gets_a_second_look_only_where_there_is_time(shared, monkeypatch, hurried):
    estimator = PoseEstimator(shared / "models")
    look, windows = estimator.detector.detect, []
    monkeypatch.setattr(
        estimator.detector, "detect", lambda image, w, least: windows.append(w) or look(image, w, least)
    )
    clear = cv2.imread(str(shared / "media" / "skier.jpg"))
    dim = cv2.GaussianBlur(clear // 12, (0, 0), 9)
    for i in range(3):
        assert estimator.process(clear, i * 33_000_000).track_id == 1
    windows.clear()
    observation = estimator.process(dim, 3 * 33_000_000, hurried=hurried)
    assert observation.track_id == 1
    assert len(windows) == (1 if hurried else 2)
    assert None not in windows  # near the subject, not over the whole


def counted(monkeypatch, owner, name):
    calls, original = [], getattr(owner, name)
    monkeypatch.setattr(owner, name, lambda *a: calls.append(1) or original(*a))
    return calls


def test_in_a_hurry_a_clear_subject_is_detected_only_when_due(shared, monkeypatch):
    estimator = PoseEstimator(shared / "models", PoseEstimatorConfig(detect_every_s=0.1))
    image = cv2.imread(str(shared / "media" / "skier.jpg"))
    assert estimator.process(image, 0).track_id == 1
    estimator._margins = None  # as with somebody near: the box cannot be carried on from the joints
    detections = counted(monkeypatch, estimator.detector, "detect")
    seen = []
    for i in range(1, 7):
        before = len(detections)
        observation = estimator.process(image, i * 33_333_333, hurried=True)
        estimator._margins = None
        assert observation.track_id == 1
        assert observation.confidence.mean() > 0.8
        seen.append(len(detections) - before)
    assert seen == [0, 0, 1, 0, 0, 1]


def test_in_a_hurry_joints_that_nobody_sees_are_looked_for_in_every_other_image(shared, monkeypatch):
    estimator = PoseEstimator(shared / "models")
    clear = cv2.imread(str(shared / "media" / "skier.jpg"))
    for i in range(3):
        assert estimator.process(clear, i * 33_000_000).track_id == 1
    dark = np.zeros_like(clear)
    estimator.process(dark, 99_000_000)
    looks = counted(monkeypatch, estimator.pose_model, "estimate")
    seen = []
    for i in range(4, 8):
        before = len(looks)
        observation = estimator.process(dark, i * 33_000_000, hurried=True)
        assert observation.track_id == 1
        seen.append(len(looks) - before)
        assert seen[-1] or np.isnan(observation.keypoints).all()
    assert seen == [0, 1, 0, 1]


def test_in_a_hurry_throughout_the_subject_is_kept_through_a_somersault(shared, monkeypatch):
    video = cv2.VideoCapture(str(shared / "media" / "outdoor_walk.mp4"))
    images = []
    for i in range(212):  # the jump's end
        image = video.read()[1]
        if i >= 100:
            images.append(cv2.resize(image, (1280, 720), interpolation=cv2.INTER_AREA))
    boxes, runs = {}, {}
    for hurried in (False, True):
        estimator = PoseEstimator(shared / "models")
        detections = counted(monkeypatch, estimator.detector, "detect")
        observations = [estimator.process(im, i * 33_333_333, hurried=hurried) for i, im in enumerate(images)]
        assert {o.track_id for o in observations} == {1}
        boxes[hurried] = np.array([o.roi for o in observations])
        runs[hurried] = len(detections)
    assert runs[True] < 0.75 * runs[False]
    low = np.maximum(boxes[False][:, :2], boxes[True][:, :2])
    high = np.minimum(boxes[False][:, 2:], boxes[True][:, 2:])
    shared_area = np.prod(np.clip(high - low, 0, None), axis=1)
    areas = [np.prod(b[:, 2:] - b[:, :2], axis=1) for b in boxes.values()]
    overlap = shared_area / (areas[0] + areas[1] - shared_area)
    assert (overlap > 0.3).mean() > 0.9
