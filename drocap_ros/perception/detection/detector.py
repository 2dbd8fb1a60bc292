"""Person detector: any supported model on a whole image or a window of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.detection.nms import suppress
from drocap_ros.perception.models.network_input import Normalizer, letterbox
from drocap_ros.perception.models.runtime import Model
from drocap_ros.perception.models.spec import ModelSpec, grid_centres, map_grid


@dataclass(frozen=True)
class Detections:
    """Persons in an image, by falling score, or in a network's input.

    boxes : (N, 4) float32 px, x_min y_min x_max y_max, clipped to the image
    scores : (N,) float32 in [0, 1]
    keypoints : (N, P, 3) x y score, of an input alone; None = the network gives none
    appearances : N descriptors, of those that a tracker assigns
    """

    boxes: np.ndarray
    scores: np.ndarray
    keypoints: np.ndarray | None = None
    appearances: Sequence[np.ndarray | None] = ()

    def __len__(self) -> int:
        return len(self.scores)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    y: np.ndarray = 1.0 / (1.0 + np.exp(-np.clip(x, -50, 50)))
    return y


def _corners(boxes: np.ndarray) -> np.ndarray:
    """Cx cy w h -> x_min y_min x_max y_max."""
    half = boxes[:, 2:4] / 2
    return np.concatenate([boxes[:, :2] - half, boxes[:, :2] + half], axis=1)


def _flat(output: np.ndarray) -> np.ndarray:
    """(1, N, C) or (N, C) -> (N, C)."""
    return output.reshape(output.shape[-2:])


def _points(rows: np.ndarray, spec: ModelSpec) -> np.ndarray | None:
    """(N, 3 P) -> (N, P, 3) keypoints; None for a model without joints."""
    return rows.reshape(len(rows), -1, 3) if spec.skeleton else None


def rtmdet_maps(outputs: list[np.ndarray], spec: ModelSpec, threshold: float) -> Detections:
    """RTMDet's raw maps: class logits and distances l t r b (px) from each cell's corner.

    Per stride either one map, classes first, or a class map and a distance map; NHWC or NCHW.
    """
    by_stride: dict[int, list[np.ndarray]] = {}
    for output in outputs:
        grid = map_grid(output.shape, spec.input_size)
        if grid is None:
            raise InputError(f"rtmdet-maps: expected maps of stride 8, 16, 32 of {spec.input_size}, got {output.shape}")
        by_stride.setdefault(grid[0], []).append(output[0] if grid[2] else np.moveaxis(output[0], 0, 2))
    boxes, scores = [], []
    for stride in sorted(by_stride):
        # The export's class map comes before its distance map.
        joined = np.concatenate(by_stride[stride], axis=2)
        score = _sigmoid(joined[..., spec.person_class])
        rows, columns = np.nonzero(score >= threshold)
        corner = np.stack([columns, rows], 1).astype(np.float32) * stride
        d = joined[rows, columns, -4:]
        boxes.append(np.concatenate([corner - d[:, :2], corner + d[:, 2:]], axis=1))
        scores.append(score[rows, columns])
    return Detections(np.concatenate(boxes), np.concatenate(scores))


def yolox_grid(outputs: list[np.ndarray], spec: ModelSpec, threshold: float) -> Detections:
    """YOLOX's grid: cx cy w h, objectness, classes; centres in cells and log sizes unless ``spec.decoded``."""
    rows = _flat(outputs[0])
    score = rows[:, 4] * rows[:, 5 + spec.person_class]
    keep = np.nonzero(score >= threshold)[0]
    boxes = rows[keep, :4].astype(np.float32)
    if not spec.decoded:
        strides = (8, 16, 32) if len(rows) == len(grid_centres(spec.input_size, (8, 16, 32))[0]) else (8, 16, 32, 64)
        corners, stride = grid_centres(spec.input_size, strides)
        s = stride[keep, None]
        boxes = np.concatenate([boxes[:, :2] * s + corners[keep], np.exp(np.clip(boxes[:, 2:], -10, 10)) * s], axis=1)
    return Detections(_corners(boxes), score[keep])


def boxes_nms(outputs: list[np.ndarray], spec: ModelSpec, threshold: float) -> Detections:
    """Model with suppression: x_min y_min x_max y_max score; a second output holds class labels or keypoints."""
    rows = _flat(outputs[0])
    keep = rows[:, 4] >= threshold
    if len(outputs) > 1 and not spec.skeleton:
        keep &= outputs[1].reshape(-1) == spec.person_class
    keypoints = _points(outputs[1].reshape(len(rows), -1)[keep], spec) if spec.skeleton else None
    return Detections(rows[keep, :4], rows[keep, 4], keypoints)


def yolo_nms(outputs: list[np.ndarray], spec: ModelSpec, threshold: float) -> Detections:
    """Model with suppression, one output: x_min y_min x_max y_max score class (and keypoints x y score)."""
    rows = _flat(outputs[0])
    rows = rows[(rows[:, 4] >= threshold) & (np.round(rows[:, 5]) == spec.person_class)]
    return Detections(rows[:, :4], rows[:, 4], _points(rows[:, 6:], spec))


def yolo(outputs: list[np.ndarray], spec: ModelSpec, threshold: float) -> Detections:
    """YOLO without objectness, channels first: cx cy w h, classes; or one class and keypoints x y score."""
    rows = _flat(outputs[0]).T
    rows = rows[rows[:, 4 + spec.person_class] >= threshold]
    return Detections(_corners(rows[:, :4]), rows[:, 4 + spec.person_class], _points(rows[:, 5:], spec))


DECODERS: dict[str, Callable[[list[np.ndarray], ModelSpec, float], Detections]] = {
    "rtmdet-maps": rtmdet_maps,
    "yolox-grid": yolox_grid,
    "boxes-nms": boxes_nms,
    "yolo-nms": yolo_nms,
    "yolo": yolo,
    "yolo-pose": yolo,
    "yolo-pose-nms": yolo_nms,
    "rtmo": boxes_nms,
}


#: Sides of an input are multiples of the coarsest map's stride, px.
_STRIDE = 32


class Detector:
    """A detector model with its spec."""

    def __init__(self, model: Model, spec: ModelSpec) -> None:
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
