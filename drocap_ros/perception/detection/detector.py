"""Person detector: any supported model on a whole image or a window of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.detection.decode import DECODERS
from drocap_ros.perception.detection.nms import suppress
from drocap_ros.perception.models.network_input import Normalizer, letterbox
from drocap_ros.perception.models.runtime import OnnxModel
from drocap_ros.perception.models.spec import ModelSpec, map_grid

#: Sides of an input are multiples of the coarsest map's stride, px.
_STRIDE = 32


@dataclass(frozen=True)
class Detections:
    """Persons in an image, by falling score.

    boxes : (N, 4) float32 px, x_min y_min x_max y_max, clipped to the image
    scores : (N,) float32 in [0, 1]
    """

    boxes: np.ndarray
    scores: np.ndarray

    def __len__(self) -> int:
        return len(self.scores)


class Detector:
    """A detector model with its spec."""

    def __init__(self, model: OnnxModel, spec: ModelSpec) -> None:
        self.model = model
        self.spec = spec
        self._normalize = Normalizer(spec)
        self._decode = DECODERS[spec.layout]
        self._dynamic: bool | None = None  # not asked yet

    def detect(
        self,
        image: np.ndarray,
        window: tuple[int, int, int, int] | None = None,
        threshold: float = 0.3,
        reduced: float | None = None,
    ) -> Detections:
        """Persons in an image.

        image : (H, W, 3) uint8 BGR
        window : x_min, y_min, x_max, y_max px inside the image; None = the whole image
        threshold : least score
        reduced : share of the network's input for the window's longer side, without padding: a faster run of a model
            with a dynamic input size; None = the full input
        """
        height, width = image.shape[:2]
        window = window or (0, 0, width, height)
        spec = self.spec
        if reduced is not None and self.accepts_other_sizes():
            spec = dataclasses.replace(spec, input_size=_reduced_size(window, reduced * min(spec.input_size)))
        canvas, place = letterbox(image, window, spec.input_size, spec.letterbox == "centre")
        raw = self._decode(self.model(self._normalize(canvas)), spec, threshold)
        corners = place.to_image(raw.boxes.astype(np.float32).reshape(-1, 2, 2))
        boxes = np.clip(corners.reshape(-1, 4), 0, np.array([width, height, width, height], np.float32))
        not_empty = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf) >= 1.0
        kept = np.nonzero(not_empty)[0]
        kept = kept[suppress(boxes[kept], raw.scores[kept])]
        return Detections(boxes[kept], raw.scores[kept].astype(np.float32))

    def accepts_other_sizes(self) -> bool:
        """Whether the network accepts inputs of other sizes, with outputs to match.

        The first answer takes a second session, which load shedding alone needs: live nodes ask before their images.
        """
        if self._dynamic is None:
            self._dynamic = self.spec.layout == "rtmdet-maps" and self._made_dynamic()
        return self._dynamic

    def _made_dynamic(self) -> bool:
        width, height = 6 * _STRIDE, 4 * _STRIDE
        if self.spec.channels_last or not self.model.make_dynamic():
            return False
        try:
            outputs = self.model(np.zeros((1, 3, height, width), np.float32))
        except InputError:
            outputs = []
        if outputs and all(map_grid(output.shape, (width, height)) for output in outputs):
            return True
        self.model.make_fixed()
        return False


def _reduced_size(window: tuple[int, int, int, int], longest: float) -> tuple[int, int]:
    """(width, height) of the smallest input that holds a window whose longer side takes ``longest`` px."""
    sides = np.array([window[2] - window[0], window[3] - window[1]])
    sides = np.ceil(np.round(sides * longest / sides.max()) / _STRIDE).astype(int) * _STRIDE
    return int(sides[0]), int(sides[1])
