"""2D pose model: any supported network on the crop of one person."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.models.preprocess import Normalizer
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.models.spec import ModelSpec
from drocap_ros.perception.pose.crop import crop_around, cut
from drocap_ros.perception.pose.heatmap import decode_heatmaps
from drocap_ros.perception.pose.network_keypoints import NetworkKeypoints, Peaks
from drocap_ros.perception.pose.regression import decode_movenet, decode_one_stage
from drocap_ros.perception.pose.simcc import decode_simcc
from drocap_ros.skeleton import JointSet, joint_set


class PoseModel:
    """A pose network with its spec; ``joints`` is its joint set."""

    def __init__(self, model: OnnxModel, spec: ModelSpec) -> None:
        self.model = model
        self.spec = spec
        self.joints: JointSet = joint_set(spec.skeleton)
        self._normalize = Normalizer(spec)

    def estimate(self, image: np.ndarray, box: np.ndarray) -> NetworkKeypoints:
        """Keypoints of the person in a box.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        box : (4,) x_min y_min x_max y_max px; may extend beyond the image
        """
        crop = crop_around(box, self.spec.input_size, self.spec.box_padding)
        outputs = self.model(self._normalize(cut(image, crop)))
        corners = np.asarray(box, np.float32).reshape(2, 2)
        in_crop = (corners - np.array(crop.centre, np.float32)) * crop.scale + np.array(crop.size) / 2
        peaks = self._decode(outputs, in_crop.reshape(4))
        inverse = np.float32(1 / crop.scale)
        candidates = peaks.candidates.copy()
        candidates[..., :2] = crop.to_image(candidates[..., :2])
        return NetworkKeypoints(
            self.joints.name, crop.to_image(peaks.xy), peaks.score, peaks.spread * inverse**2, candidates,
            float(max(box[2] - box[0], box[3] - box[1])),
        )  # fmt: skip

    def _decode(self, outputs: list[np.ndarray], box: np.ndarray) -> Peaks:
        size = self.spec.input_size
        if self.spec.layout == "heatmap":
            # Each stack of an hourglass network refines the previous one.
            return decode_heatmaps(outputs[-1][0], size, self.spec.udp)
        if self.spec.layout == "simcc":
            return decode_simcc(outputs[0][0], outputs[1][0], size)
        if self.spec.layout == "movenet":
            return decode_movenet(outputs[0], size)
        return decode_one_stage(outputs, self.spec, box, len(self.joints))
