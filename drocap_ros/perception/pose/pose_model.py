"""2D pose model: any supported network on the crop of one person, and the peaks of its outputs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.perception.detection.detector import DECODERS
from drocap_ros.perception.detection.nms import TOUCHES, iou
from drocap_ros.perception.models.network_input import Normalizer, crop_around, cut
from drocap_ros.perception.models.runtime import Model
from drocap_ros.perception.models.spec import ModelSpec
from drocap_ros.skeleton import JointSet, joint_set

#: Least height of a second peak, as a share of the highest one; less is noise of the network.
_LEAST_SECOND = 0.1
#: Height over the peak's below which a distribution is background.
_BACKGROUND = 0.05
#: Standard deviation in cells of the Gaussian in the training targets (MMPose, PaddleDetection).
_TRAINED_SIGMA = 2.0
#: Half the window of second moments in trained widths; SimCC's is sqrt(side / 8) (RTMPose: 5.66 px for 256).
_WINDOW_SIGMAS = 3.0


class Peaks(NamedTuple):
    """P joints in px of a model's input.

    xy : (P, 2) float32
    score : (P,) float32, height of the peak
    spread : (P, 3) float32 px^2, xx xy yy: second moments of the distribution around the peak, beyond the trained
        width of the peak
    second : (P,) float32, height of the second peak; 0 = none, or unknown
    """

    xy: np.ndarray
    score: np.ndarray
    spread: np.ndarray
    second: np.ndarray


def certain_peaks(points: np.ndarray) -> Peaks:
    """(P, 3) x y px and score -> peaks of unknown distribution."""
    zeros = np.zeros((len(points), 4), np.float32)
    return Peaks(points[:, :2].astype(np.float32), points[:, 2].astype(np.float32), zeros[:, :3], zeros[:, 3])


def decode_movenet(output: np.ndarray, input_size: tuple[int, int]) -> Peaks:
    """MoveNet (1, 1, P, 3): y, x as shares of the input, score."""
    rows = output.reshape(output.shape[-2:])
    points = np.stack([rows[:, 1] * input_size[0], rows[:, 0] * input_size[1], rows[:, 2]], -1)
    return certain_peaks(points.astype(np.float32))


def decode_heatmaps(maps: np.ndarray, input_size: tuple[int, int], udp: bool = False) -> Peaks:
    """Joints of a stack of heatmaps.

    The position is the maximum of the logarithm's Taylor expansion after smoothing (Zhang et al.,
    "Distribution-aware coordinate representation", 2020), exact for a Gaussian peak.

    maps : (P, h, w) float32, larger = more likely
    input_size : (width, height) px of the network's input
    udp : network trained with unit-length coordinates (Huang et al., "The Devil is in the details", 2020): its first
        and last cells lie on the first and last pixels
    """
    _, rows, columns = maps.shape
    less = 1 if udp else 0
    stride = np.array([(input_size[0] - less) / (columns - less), (input_size[1] - less) / (rows - less)], np.float32)
    place = maps.reshape(len(maps), -1).argmax(axis=1)
    top = np.stack([place % columns, place // columns], -1)
    score = maps[np.arange(len(maps)), top[:, 1], top[:, 0]]
    xy = _newton_step(maps, top)
    # Training draws the peak of a joint at pixel x at cell x / stride, not at the cell's middle.
    scale = np.array([stride[0] ** 2, stride[0] * stride[1], stride[1] ** 2], np.float32)
    return Peaks(xy * stride, score, _moments(maps, top, xy) * scale, _second_peak(maps, top, score))


def _second_peak(maps: np.ndarray, top: np.ndarray, score: np.ndarray) -> np.ndarray:
    """(P,) height of the highest local maximum beside the top cell; 0 where there is none."""
    j, y, x = np.nonzero(maps > _LEAST_SECOND * score[:, None, None])
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    around = np.stack([padded[j, y + dy, x + dx] for dy in range(3) for dx in range(3)])
    peak = (around[4] >= around.max(axis=0)) & ((y != top[j, 1]) | (x != top[j, 0]))
    second = np.zeros(len(maps), np.float32)
    np.maximum.at(second, j[peak], around[4][peak])
    return second


def _newton_step(maps: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """(P, 2) float32 cells: one Newton step on the logarithm from the highest cell, at most one cell long.

    Around it the maps are smoothed by three binomial weights along both axes, their border repeated.
    """
    joints, rows, columns = maps.shape
    x = np.clip(peak[:, 0], 1, columns - 2)
    y = np.clip(peak[:, 1], 1, rows - 2)
    j = np.arange(joints)[:, None, None]
    five = np.arange(-2, 3)
    down, across = np.clip(y[:, None] + five, 0, rows - 1), np.clip(x[:, None] + five, 0, columns - 1)
    patch = np.maximum(maps[j, down[:, :, None], across[:, None, :]], 0.0)
    patch = 0.25 * patch[:, :-2] + 0.5 * patch[:, 1:-1] + 0.25 * patch[:, 2:]
    patch = 0.25 * patch[:, :, :-2] + 0.5 * patch[:, :, 1:-1] + 0.25 * patch[:, :, 2:]
    f = np.log(np.maximum(patch, 1e-10))
    gx, gy = (f[:, 1, 2] - f[:, 1, 0]) / 2, (f[:, 2, 1] - f[:, 0, 1]) / 2
    hxx = f[:, 1, 2] - 2 * f[:, 1, 1] + f[:, 1, 0]
    hyy = f[:, 2, 1] - 2 * f[:, 1, 1] + f[:, 0, 1]
    hxy = (f[:, 2, 2] - f[:, 2, 0] - f[:, 0, 2] + f[:, 0, 0]) / 4
    determinant = hxx * hyy - hxy**2
    curved = (determinant > 1e-8) & (hxx < 0)
    safe = np.where(curved, determinant, 1.0)
    dx = np.where(curved, -(hyy * gx - hxy * gy) / safe, 0.0)
    dy = np.where(curved, -(hxx * gy - hxy * gx) / safe, 0.0)
    return np.stack([x + np.clip(dx, -1, 1), y + np.clip(dy, -1, 1)], -1).astype(np.float32)


def _moments(maps: np.ndarray, peak: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(P, 3) cells^2: second moments about the joint within a window, less the trained width, at least 0."""
    joints, rows, columns = maps.shape
    radius = round(_WINDOW_SIGMAS * _TRAINED_SIGMA)
    steps = np.arange(-radius, radius + 1)
    px, py = peak[:, :1] + steps, peak[:, 1:] + steps  # (P, n)
    inside = ((py >= 0) & (py < rows))[:, :, None] & ((px >= 0) & (px < columns))[:, None, :]
    j = np.arange(joints)[:, None, None]
    patch = maps[j, np.clip(py, 0, rows - 1)[:, :, None], np.clip(px, 0, columns - 1)[:, None, :]]
    top = maps[np.arange(joints), peak[:, 1], peak[:, 0]]
    weight = np.where(inside, np.maximum(patch - _BACKGROUND * top[:, None, None], 0.0), 0.0)
    weight /= np.maximum(weight.sum(axis=(1, 2), keepdims=True), 1e-12)
    dx, dy = (px - xy[:, :1])[:, None, :], (py - xy[:, 1:])[:, :, None]
    xx = np.maximum((weight * dx**2).sum(axis=(1, 2)) - _TRAINED_SIGMA**2, 0.0)
    yy = np.maximum((weight * dy**2).sum(axis=(1, 2)) - _TRAINED_SIGMA**2, 0.0)
    most = 0.95 * np.sqrt(xx * yy)
    return np.stack([xx, np.clip((weight * dx * dy).sum(axis=(1, 2)), -most, most), yy], -1).astype(np.float32)


def decode_simcc(x: np.ndarray, y: np.ndarray, input_size: tuple[int, int]) -> Peaks:
    """Joints of two stacks of 1-D responses.

    x : (P, width * k) float32; y : (P, height * k) float32, both with peak height about the confidence
    input_size : (width, height) px of the network's input
    """
    at_x, spread_x = _parabola(x, input_size[0])
    at_y, spread_y = _parabola(y, input_size[1])
    spread = np.stack([spread_x, np.zeros_like(spread_x), spread_y], -1).astype(np.float32)
    score = np.minimum(x.max(axis=1), y.max(axis=1)).astype(np.float32)
    return Peaks(np.stack([at_x, at_y], -1).astype(np.float32), score, spread, np.zeros_like(score))


def _parabola(response: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """(P,) px position from a parabola through three bins, and (P,) px^2 spread beyond the trained width."""
    bins = response.shape[1]
    ratio = bins / side
    rows = np.arange(len(response))
    at = np.clip(response.argmax(axis=1), 1, bins - 2)
    left, mid, right = response[rows, at - 1], response[rows, at], response[rows, at + 1]
    bend = left - 2 * mid + right
    shift = np.where(bend < -1e-9, (left - right) / np.where(bend < -1e-9, 2 * bend, 1.0), 0.0)
    position = at + np.clip(shift, -1, 1)
    sigma = np.sqrt(side / 8.0) * ratio
    reach = int(np.ceil(_WINDOW_SIGMAS * sigma))
    index = at[:, None] + np.arange(-reach, reach + 1)
    inside = (index >= 0) & (index < bins)
    patch = np.take_along_axis(response, np.clip(index, 0, bins - 1), 1)
    weight = np.where(inside, np.maximum(patch - _BACKGROUND * mid[:, None], 0.0), 0.0)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-12)
    moment = (weight * (index - position[:, None]) ** 2).sum(1) - sigma**2
    return position / ratio, np.maximum(moment, 0.0) / ratio**2


#: Least score of a person of a one-stage model: the detector has seen the person already.
_LEAST_SCORE = 0.05


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

    def __init__(self, model: Model, spec: ModelSpec) -> None:
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
        in_crop = (corners - np.array(crop.origin, np.float32) - 0.5) * crop.scale + np.array(crop.size) / 2
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
        worth = np.where(overlap >= TOUCHES, overlap * raw.scores, 0.0)
        if raw.keypoints is None or not worth.any():
            return certain_peaks(np.zeros((len(self.joints), 3), np.float32))
        return certain_peaks(raw.keypoints[int(np.argmax(worth))])
