"""SimCC decoding: two 1-D distributions per joint -> joints with spread and further peaks."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.pose.heatmap import CANDIDATES
from drocap_ros.perception.pose.network_keypoints import Peaks

#: Window of the spread in trained widths of the 1-D Gaussian, sqrt(side / 8) (RTMPose: 5.66 px for 256, 4.9 for 192).
_WINDOW_SIGMAS = 3.0


def decode_simcc(x: np.ndarray, y: np.ndarray, input_size: tuple[int, int]) -> Peaks:
    """Joints of two stacks of 1-D responses.

    Parameters
    ----------
    x : (P, width * k) float32; y : (P, height * k) float32, both with peak height about the confidence
    input_size : (width, height) px of the network's input
    """
    tops_x, height_x = _local_maxima(x)
    tops_y, height_y = _local_maxima(y)
    at_x, spread_x = _refine(x, tops_x[:, 0], input_size[0])
    at_y, spread_y = _refine(y, tops_y[:, 0], input_size[1])
    xy = np.stack([at_x, at_y], -1)
    spread = np.stack([spread_x, np.zeros_like(spread_x), spread_y], -1).astype(np.float32)
    # Further candidates: the second-best bin of one axis with the best of the other.
    ratio = np.array([x.shape[1] / input_size[0], y.shape[1] / input_size[1]], np.float32)
    candidates = np.full((len(x), CANDIDATES, 3), np.nan, np.float32)
    candidates[:, 0, :2] = xy
    candidates[:, 0, 2] = np.minimum(height_x[:, 0], height_y[:, 0])
    candidates[:, 1] = np.stack([tops_x[:, 1] / ratio[0], at_y, np.minimum(height_x[:, 1], height_y[:, 0])], -1)
    candidates[:, 2] = np.stack([at_x, tops_y[:, 1] / ratio[1], np.minimum(height_x[:, 0], height_y[:, 1])], -1)
    candidates[~np.isfinite(candidates[..., 2])] = np.nan
    return Peaks(xy.astype(np.float32), candidates[:, 0, 2].copy(), spread, candidates)


def _local_maxima(response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P, 2) bins and heights of the two highest local maxima; -inf for a missing one."""
    padded = np.pad(response, ((0, 0), (1, 1)), constant_values=-np.inf)
    highest = np.maximum(padded[:, :-2], padded[:, 2:])
    peaks = np.where(response >= highest, response, -np.inf)
    order = np.argsort(-peaks, axis=1, kind="stable")[:, :2]
    return order, np.take_along_axis(peaks, order, 1).astype(np.float32)


def _refine(response: np.ndarray, peak: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """(P,) px position from a parabola through three bins, and (P,) px^2 spread beyond the trained width."""
    bins = response.shape[1]
    ratio = bins / side
    rows = np.arange(len(response))
    at = np.clip(peak, 1, bins - 2)
    left, mid, right = response[rows, at - 1], response[rows, at], response[rows, at + 1]
    bend = left - 2 * mid + right
    shift = np.where(bend < -1e-9, (left - right) / np.where(bend < -1e-9, 2 * bend, 1.0), 0.0)
    position = at + np.clip(shift, -1, 1)
    sigma = np.sqrt(side / 8.0) * ratio
    reach = int(np.ceil(_WINDOW_SIGMAS * sigma))
    steps = np.arange(-reach, reach + 1)
    index = at[:, None] + steps
    inside = (index >= 0) & (index < bins)
    patch = np.take_along_axis(response, np.clip(index, 0, bins - 1), 1)
    weight = np.where(inside, np.maximum(patch - 0.05 * mid[:, None], 0.0), 0.0)
    weight /= np.maximum(weight.sum(1, keepdims=True), 1e-12)
    moment = (weight * (index - position[:, None]) ** 2).sum(1) - sigma**2
    return position / ratio, np.maximum(moment, 0.0) / ratio**2
