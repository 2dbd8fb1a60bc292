from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_models import write_model

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.perception.detection.nms import iou, suppress
from drocap_ros.perception.load_models import load_detector
from drocap_ros.perception.models.network_input import letterbox
from drocap_ros.perception.models.spec import grid_centres
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

#: Output of every tiny model, in px of its 128x96 input; the image is twice as large.
BOX = np.array([40.0, 20.0, 72.0, 84.0])
SIZE = (128, 96)
IMAGE = np.zeros((192, 256, 3), np.uint8)


def logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def rtmdet_maps(split: bool) -> dict[str, np.ndarray]:
    outputs: dict[str, np.ndarray] = {}
    for stride in (8, 16, 32):
        grid = np.full((SIZE[1] // stride, SIZE[0] // stride, 5), logit(0.01), np.float32)
        if stride == 16:
            row, column = 3, 3
            x, y = column * stride, row * stride
            grid[row, column] = [logit(0.9), x - BOX[0], y - BOX[1], BOX[2] - x, BOX[3] - y]
        if split:
            outputs[f"cls{stride}"] = np.moveaxis(grid[..., :1], 2, 0)[None].copy()
            outputs[f"box{stride}"] = np.moveaxis(grid[..., 1:], 2, 0)[None].copy()
        else:
            outputs[f"map{stride}"] = grid[None]
    return outputs


def yolox(decoded: bool) -> dict[str, np.ndarray]:
    corners, strides = grid_centres(SIZE, (8, 16, 32))
    centre, size = (BOX[:2] + BOX[2:]) / 2, BOX[2:] - BOX[:2]
    rows = np.zeros((len(corners), 7), np.float32)
    rows[:, 4] = 0.01
    if decoded:
        rows[:, :2], rows[:, 2:4] = corners, strides[:, None]
    for i in (70, 71):  # two cells see the same person
        rows[i, 4:] = [0.95, 0.9 if i == 70 else 0.8, 0.0]
        rows[i, :2] = centre if decoded else (centre - corners[i]) / strides[i]
        rows[i, 2:4] = size if decoded else np.log(size / strides[i])
    return {"output": rows[None]}


def end_to_end() -> dict[str, np.ndarray]:
    dets = np.array([[[*BOX, 0.85], [0, 0, 30, 30, 0.99], [5, 5, 9, 9, 0.01]]], np.float32)
    return {"dets": dets, "labels": np.array([[0, 7, 0]], np.int64)}


def yolo_pose(nms: bool) -> dict[str, np.ndarray]:
    points = np.column_stack([np.linspace(BOX[0], BOX[2], 17), np.linspace(BOX[1], BOX[3], 17), np.full(17, 0.8)])
    if nms:
        rows = np.zeros((1, 20, 57), np.float32)
        rows[0, 0] = [*BOX, 0.85, 0, *points.ravel()]
        return {"output": rows}
    count = len(grid_centres(SIZE, (8, 16, 32))[0])
    rows = np.zeros((1, 56, count), np.float32)
    rows[0, :, 40] = [*(BOX[:2] + BOX[2:]) / 2, *(BOX[2:] - BOX[:2]), 0.85, *points.ravel()]
    return {"output": rows}


def yolov8() -> dict[str, np.ndarray]:
    count = len(grid_centres(SIZE, (8, 16, 32))[0])
    rows = np.zeros((1, 84, count), np.float32)
    rows[0, :5, 40] = [*(BOX[:2] + BOX[2:]) / 2, *(BOX[2:] - BOX[:2]), 0.85]
    return {"output": rows}


def rtmo() -> dict[str, np.ndarray]:
    points = np.zeros((1, 2, 17, 3), np.float32)
    points[0, 0] = [50, 50, 0.7]
    return {"dets": np.array([[[*BOX, 0.85], [0, 0, 5, 5, 0.0]]], np.float32), "keypoints": points}


BGR = "colour: bgr\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n"
LAYOUTS = {
    "rtmdet raw, one map a stride": ("a.onnx", rtmdet_maps(False), "rtmdet-maps"),
    "rtmdet raw, two maps a stride": ("a.onnx", rtmdet_maps(True), "rtmdet-maps"),
    "rtmdet with NMS": ("rtmdet-s.onnx", end_to_end(), "boxes-nms"),
    "yolox raw": ("a.onnx", yolox(False), "yolox-grid"),
    "yolox with NMS": ("my_yolox.onnx", end_to_end(), "boxes-nms"),
    "yolox decoded": ("a.onnx", yolox(True), "yolox-grid"),
    "yolo": ("a.onnx", yolov8(), "yolo"),
    "yolo with NMS": ("a.onnx", {"o": np.array([[[*BOX, 0.85, 0], [1, 1, 50, 50, 0.9, 3]]], np.float32)}, "yolo-nms"),
    "yolo-pose": ("a.onnx", yolo_pose(False), "yolo-pose"),
    "yolo-pose with NMS": ("a.onnx", yolo_pose(True), "yolo-pose-nms"),
    "rtmo": ("a.onnx", rtmo(), "rtmo"),
}


@pytest.mark.parametrize(("file", "outputs", "layout"), LAYOUTS.values(), ids=LAYOUTS)
def test_named_layout_is_decoded(tmp_path, file, outputs, layout):
    write_model(tmp_path / file, (1, 3, SIZE[1], SIZE[0]), outputs)
    decoded = layout == "yolox-grid" and bool((outputs["output"] > 30).any())
    text = f"layout: {layout}\ndecoded: {decoded}\n" + BGR * (layout == "boxes-nms")
    (tmp_path / file).with_suffix(".yaml").write_text(text)
    detector = load_detector(tmp_path, PoseEstimatorConfig())
    assert detector.spec.layout == layout
    found = detector.detect(IMAGE, None, 0.3)
    assert len(found) == 1
    np.testing.assert_allclose(found.boxes[0], 2 * BOX, atol=0.05)
    assert 0.8 < found.scores[0] <= 0.95


def test_boxes_of_a_window_are_in_image_px(tmp_path):
    write_model(tmp_path / "rtmdet.onnx", (1, 3, SIZE[1], SIZE[0]), end_to_end())
    (tmp_path / "rtmdet.yaml").write_text("layout: boxes-nms\n" + BGR)
    detector = load_detector(tmp_path, PoseEstimatorConfig())
    found = detector.detect(np.zeros((400, 600, 3), np.uint8), (100, 50, 100 + 128, 50 + 96), 0.3)
    np.testing.assert_allclose(found.boxes[0], BOX + np.array([100, 50, 100, 50]), atol=0.01)


def test_outputs_that_two_families_share_need_a_yaml(tmp_path, capsys):
    write_model(tmp_path / "best.onnx", (1, 3, SIZE[1], SIZE[0]), end_to_end())
    with pytest.raises(InputError, match=r"best\.yaml, which says what it is.*models list --write"):
        load_detector(tmp_path, PoseEstimatorConfig())
    assert main(["models", "list", "--write", "--models", str(tmp_path)]) == 0
    assert f"written: {tmp_path}/best.yaml" in capsys.readouterr().out
    text = (tmp_path / "best.yaml").read_text().replace("layout:", "layout: boxes-nms")
    (tmp_path / "best.yaml").write_text(text)
    with pytest.raises(InputError, match="expected colour, mean, std"):
        load_detector(tmp_path, PoseEstimatorConfig())
    for name in ("colour", "mean", "std"):
        text = text.replace(f"# {name}", name)
    (tmp_path / "best.yaml").write_text(text)
    assert len(load_detector(tmp_path, PoseEstimatorConfig()).detect(IMAGE, None, 0.3)) == 1


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 400), st.integers(1, 400), st.booleans(), st.integers(0, 2**32 - 1))
def test_letterbox_is_invertible(width, height, centred, seed):
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.uint8)
    canvas, place = letterbox(image, (0, 0, width, height), (64, 48), centred)
    assert canvas.shape == (48, 64, 3)
    points = rng.uniform(0, 1, (5, 2)) * [width, height]
    there = (points - place.origin) * place.scale + place.offset
    assert (there >= -1e-3).all()
    assert (there <= np.array([64, 48]) + 1e-3).all()
    np.testing.assert_allclose(place.to_image(there), points, atol=1e-2)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 30), st.floats(0.1, 0.9), st.integers(0, 2**32 - 1))
def test_suppression_keeps_the_best_of_each_overlap(count, threshold, seed):
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 50, (count, 2))
    boxes = np.concatenate([low, low + rng.uniform(1, 40, (count, 2))], axis=1)
    scores = rng.uniform(0, 1, count)
    kept = suppress(boxes, scores, threshold)
    overlap = iou(boxes[kept], boxes[kept]) - np.eye(len(kept))
    assert (overlap <= threshold + 1e-9).all()
    assert (np.diff(scores[kept]) <= 0).all()
    dropped = np.setdiff1d(np.arange(count), kept)
    for i in dropped:  # a better box overlaps each one dropped
        assert (iou(boxes[i][None], boxes[kept])[0][scores[kept] >= scores[i]] > threshold).any()
