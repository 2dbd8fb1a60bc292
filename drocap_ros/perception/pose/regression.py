"""Regression-based models, which output coordinates instead of distributions: MoveNet, YOLO-pose, RTMO."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.decode import DECODERS
from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.models.spec import ModelSpec
from drocap_ros.perception.pose.heatmap import CANDIDATES
from drocap_ros.perception.pose.network_keypoints import Peaks


def as_peaks(points: np.ndarray) -> Peaks:
    """(P, 3) x y px and score -> peaks of unknown distribution (spread 0)."""
    candidates = np.full((len(points), CANDIDATES, 3), np.nan, np.float32)
    candidates[:, 0] = points
    spread = np.zeros((len(points), 3), np.float32)
    return Peaks(points[:, :2].astype(np.float32), points[:, 2].astype(np.float32), spread, candidates)


def decode_movenet(output: np.ndarray, input_size: tuple[int, int]) -> Peaks:
    """MoveNet (1, 1, P, 3): y, x as shares of the input, score."""
    rows = output.reshape(output.shape[-2:])
    points = np.stack([rows[:, 1] * input_size[0], rows[:, 0] * input_size[1], rows[:, 2]], -1)
    return as_peaks(points.astype(np.float32))


def decode_one_stage(outputs: list[np.ndarray], spec: ModelSpec, box: np.ndarray, joints: int) -> Peaks:
    """The person in a one-stage model's output that overlaps ``box`` (4,) input px most; scores 0 without one."""
    raw = DECODERS[spec.layout](outputs, spec, 0.05)
    if raw.keypoints is None or not len(raw.scores):
        return as_peaks(np.zeros((joints, 3), np.float32))
    overlap = iou(raw.boxes.astype(np.float32), box[None].astype(np.float32))[:, 0]
    best = int(np.argmax(overlap * raw.scores))
    if overlap[best] < 0.1:
        return as_peaks(np.zeros((joints, 3), np.float32))
    return as_peaks(raw.keypoints[best])
