"""A person detector: any supported model, over the whole image or a window of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.detection.decode import DECODERS
from drocap_ros.perception.detection.letterbox import letterbox
from drocap_ros.perception.detection.nms import suppress
from drocap_ros.perception.model_spec import ModelSpec
from drocap_ros.perception.preprocess import Normalizer
from drocap_ros.perception.runtime import OnnxModel


@dataclass(frozen=True)
class Detections:
    """Persons in an image, by falling score.

    boxes : (N, 4) float32 px, x_min y_min x_max y_max, clipped to the image
    scores : (N,) float32 in [0, 1]
    keypoints : (N, P, 3) float32 x y px and score, from a one-stage model, else None
    """

    boxes: np.ndarray
    scores: np.ndarray
    keypoints: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.scores)


class Detector:
    """A detector model with its spec."""

    def __init__(self, model: OnnxModel, spec: ModelSpec, nms_iou: float = 0.6) -> None:
        self.model = model
        self.spec = spec
        self._nms_iou = nms_iou
        self._normalize = Normalizer(spec)
        self._decode = DECODERS[spec.layout]

    def detect(
        self, image: np.ndarray, window: tuple[int, int, int, int] | None = None, threshold: float = 0.3
    ) -> Detections:
        """Persons in an image.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        window : x_min, y_min, x_max, y_max px inside the image; None = all of it
        threshold : least score
        """
        height, width = image.shape[:2]
        canvas, place = letterbox(
            image, window or (0, 0, width, height), self.spec.input_size, self.spec.letterbox == "centre"
        )
        raw = self._decode(self.model(self._normalize(canvas)), self.spec, threshold)
        boxes = place.boxes_to_image(raw.boxes.astype(np.float32))
        boxes = np.clip(boxes, 0, np.array([width, height, width, height], np.float32))
        solid = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf) >= 1.0
        kept = np.nonzero(solid)[0]
        kept = kept[suppress(boxes[kept], raw.scores[kept], self._nms_iou)]
        keypoints = None
        if raw.keypoints is not None:
            points = raw.keypoints[kept].astype(np.float32)
            keypoints = np.concatenate([place.to_image(points[..., :2]), points[..., 2:]], axis=-1)
        return Detections(boxes[kept], raw.scores[kept].astype(np.float32), keypoints)
