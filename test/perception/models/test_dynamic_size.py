"""Detectors with a dynamic input size."""

import sys

import cv2
import numpy as np
import pytest
from tiny_models import write_model

from drocap_ros.perception.load_models import load_detector
from drocap_ros.perception.models.runtime import with_dynamic_size
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

CONFIG = PoseEstimatorConfig(detector="rtmdet-nano")


@pytest.fixture
def walk(shared):
    image = cv2.VideoCapture(str(shared / "media" / "outdoor_walk.mp4")).read()[1]
    return cv2.resize(image, (1280, 720), interpolation=cv2.INTER_AREA)


def sizes_seen(monkeypatch, detector):
    seen, run = [], type(detector.model).__call__
    monkeypatch.setattr(type(detector.model), "__call__", lambda self, x: seen.append(x.shape[:1:-1]) or run(self, x))
    return seen


@pytest.mark.parametrize(
    ("window", "reduced", "size"),
    [
        (None, 1.0, (320, 192)),
        ((300, 0, 700, 400), 0.8, (256, 256)),
        ((300, 0, 500, 400), 0.8, (128, 256)),
    ],
)
def test_reduced_input_shows_the_same_person(shared, walk, monkeypatch, window, reduced, size):
    detector = load_detector(shared / "models", CONFIG)
    whole = detector.detect(walk, window)
    assert detector.accepts_other_sizes()
    seen = sizes_seen(monkeypatch, detector)
    found = detector.detect(walk, window, reduced=reduced)
    assert seen == [size]
    length = (whole.boxes[0, 2:] - whole.boxes[0, :2]).max()
    assert np.abs(found.boxes[0] - whole.boxes[0]).max() < 0.08 * length
    assert found.scores[0] > 0.6


def test_full_input_equals_the_fixed_export(shared, walk, monkeypatch):
    free, fixed = load_detector(shared / "models", CONFIG), load_detector(shared / "models", CONFIG)
    assert free.accepts_other_sizes()
    seen = sizes_seen(monkeypatch, free)
    a, b = free.detect(walk), fixed.detect(walk)
    assert seen == [(320, 320)] * 2
    np.testing.assert_array_equal(a.boxes, b.boxes)
    np.testing.assert_array_equal(a.scores, b.scores)


def tiny_maps():
    return {f"map{s}": np.full((1, 96 // s, 128 // s, 5), -5, np.float32) for s in (8, 16, 32)}


def test_network_with_fixed_outputs_keeps_its_size(tmp_path, monkeypatch):
    write_model(tmp_path / "rtmdet-tiny.onnx", (1, 3, 96, 128), tiny_maps(), layout="rtmdet-maps")
    detector = load_detector(tmp_path, PoseEstimatorConfig())
    assert not detector.accepts_other_sizes()
    seen = sizes_seen(monkeypatch, detector)
    assert len(detector.detect(np.zeros((200, 300, 3), np.uint8), reduced=0.5)) == 0
    assert seen == [(128, 96)]


def test_size_is_fixed_without_the_package_onnx(shared, walk, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    detector = load_detector(shared / "models", CONFIG)
    seen = sizes_seen(monkeypatch, detector)
    assert detector.detect(walk, reduced=0.8).scores[0] > 0.6
    assert seen == [(320, 320)]


def test_invalid_model_has_no_dynamic_size(tmp_path):
    path = tmp_path / "broken.onnx"
    for content in (b"", b"not a model", bytes(range(256)) * 9):
        path.write_bytes(content)
        assert with_dynamic_size(path) is None
    assert with_dynamic_size(tmp_path / "missing.onnx") is None
