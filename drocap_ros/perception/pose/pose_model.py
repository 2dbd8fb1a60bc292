"""2D pose model: any supported network on the crop of one person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.perception.detection.decode import DECODERS
from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.models.network_input import Normalizer, crop_around, cut
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.models.spec import ModelSpec
from drocap_ros.perception.pose.peaks import Peaks, certain_peaks, decode_heatmaps, decode_movenet, decode_simcc
from drocap_ros.skeleton import JointSet, joint_set

#: Least score of a person of a one-stage model: the detector has seen the person already;
_LEAST_SCORE = 0.05
#: and least overlap (IoU) with the box of the crop: another person's box hardly has it.
_LEAST_OVERLAP = 0.1


class NetworkKeypoints(NamedTuple):
    """Keypoints of one person in image px, before calibration; other fields as in :class:`.peaks.Peaks`.

    skeleton : name of the joint set
    box_size : px, longer side of the person's box, the unit of the calibration
    space : (P, 3) m, x right, y down, z away along the ray to the person, of a network that gives it; else None
    """

    skeleton: str
    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    second: np.ndarray
    box_size: float
    space: np.ndarray | None = None


class PoseModel:
    """A pose network with its spec; ``joints`` is its joint set."""

    def __init__(self, model: OnnxModel, spec: ModelSpec) -> None:
        self.model = model
        self.spec = spec
        self.joints: JointSet = joint_set(spec.skeleton)
        self._normalize = Normalizer(spec)

    def estimate(self, image: np.ndarray, box: np.ndarray) -> NetworkKeypoints:
        """Keypoints of the person in a box.

        image : (H, W, 3) uint8 BGR
        box : (4,) x_min y_min x_max y_max px; may extend beyond the image
        """
        crop = crop_around(box, self.spec.input_size, self.spec.box_padding)
        outputs = self.model(self._normalize(cut(image, crop)))
        corners = np.asarray(box, np.float32).reshape(2, 2)
        in_crop = (corners - np.array(crop.centre, np.float32)) * crop.scale + np.array(crop.size) / 2
        peaks = self._decode(outputs, in_crop.reshape(4))
        spread = peaks.spread * np.float32(1 / crop.scale) ** 2
        size = float(max(box[2] - box[0], box[3] - box[1]))
        space = outputs[1][0] if self.spec.layout == "movenet" and len(outputs) > 1 else None
        xy = crop.to_image(peaks.xy)
        return NetworkKeypoints(self.joints.name, xy, peaks.score, spread, peaks.second, size, space)

    def _decode(self, outputs: list[np.ndarray], box: np.ndarray) -> Peaks:
        size = self.spec.input_size
        if self.spec.layout == "heatmap":
            # Each stack of an hourglass network refines the previous one.
            return decode_heatmaps(outputs[-1][0], size, self.spec.udp)
        if self.spec.layout == "simcc":
            return decode_simcc(outputs[0][0], outputs[1][0], size)
        if self.spec.layout == "movenet":
            return decode_movenet(outputs[0], size)
        return self._one_stage(outputs, box)

    def _one_stage(self, outputs: list[np.ndarray], box: np.ndarray) -> Peaks:
        """The person in a one-stage model's output that overlaps ``box`` (4,) input px most; scores 0 without one."""
        raw = DECODERS[self.spec.layout](outputs, self.spec, _LEAST_SCORE)
        overlap = iou(raw.boxes.astype(np.float32), box[None].astype(np.float32))[:, 0]
        worth = np.where(overlap >= _LEAST_OVERLAP, overlap * raw.scores, 0.0)
        if raw.keypoints is None or not worth.any():
            return certain_peaks(np.zeros((len(self.joints), 3), np.float32))
        return certain_peaks(raw.keypoints[int(np.argmax(worth))])
