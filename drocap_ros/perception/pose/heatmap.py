"""Heatmap decoding: (P, h, w) -> joints with sub-pixel positions, spread and further peaks."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.pose.network_keypoints import Peaks

#: Radius in cells of the window for the second moments around a peak.
_RADIUS = 6
#: Peaks reported per joint, the highest first.
CANDIDATES = 3
#: Least height of a further candidate, as a share of the highest peak.
_LEAST_CANDIDATE = 0.1
#: Standard deviation in cells of the Gaussian in the training targets.
_TRAINED_SIGMA = 2.0


def decode_heatmaps(maps: np.ndarray, input_size: tuple[int, int], udp: bool = False) -> Peaks:
    """Joints of a stack of heatmaps.

    The position is the maximum of the logarithm's Taylor expansion after smoothing (Zhang et al.,
    "Distribution-aware coordinate representation", 2020), exact for a Gaussian peak.

    Parameters
    ----------
    maps : (P, h, w) float32, larger = more likely
    input_size : (width, height) px of the network's input
    udp : network trained with unit-length coordinates (Huang et al., "The Devil is in the details", 2020): its first
        and last cells lie on the first and last pixels
    """
    _, rows, columns = maps.shape
    less = 1 if udp else 0
    stride = np.array([(input_size[0] - less) / (columns - less), (input_size[1] - less) / (rows - less)], np.float32)
    tops, scores = _local_maxima(maps)
    smooth = _blur(np.maximum(maps, 0.0))
    xy = _refine(smooth, tops[:, 0])
    spread = _spread(maps, tops[:, 0], xy)
    candidates = np.concatenate([tops.astype(np.float32), scores[..., None]], axis=2)
    candidates[:, 0, :2] = xy
    # Training draws the peak of a joint at pixel x at cell x / stride, not at the cell's middle.
    candidates[..., :2] *= stride
    candidates[~np.isfinite(scores)] = np.nan
    scale = np.array([stride[0] ** 2, stride[0] * stride[1], stride[1] ** 2], np.float32)
    return Peaks(candidates[:, 0, :2].copy(), scores[:, 0].copy(), spread * scale, candidates)


def _local_maxima(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P, K, 2) int x y and (P, K) heights of the highest local maxima; -inf where there are fewer."""
    joints, _, columns = maps.shape
    flat = maps.reshape(joints, -1)
    top = flat.argmax(axis=1)
    heights = np.full((joints, CANDIDATES), -np.inf, np.float32)
    picked = np.repeat(top[:, None], CANDIDATES, axis=1)
    heights[:, 0] = flat[np.arange(joints), top]
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    across = np.maximum(np.maximum(padded[:, :, :-2], padded[:, :, 1:-1]), padded[:, :, 2:])
    highest = np.maximum(np.maximum(across[:, :-2], across[:, 1:-1]), across[:, 2:])
    # The bound keeps the sort short.
    peak = (maps >= highest) & (maps > _LEAST_CANDIDATE * heights[:, 0, None, None])
    joint, place = np.nonzero(peak.reshape(joints, -1))
    other = place != top[joint]
    joint, place = joint[other], place[other]
    value = flat[joint, place]
    order = np.lexsort((place, -value, joint))
    joint, place, value = joint[order], place[order], value[order]
    rank = np.arange(len(joint)) - np.searchsorted(joint, joint) + 1
    kept = rank < CANDIDATES
    picked[joint[kept], rank[kept]] = place[kept]
    heights[joint[kept], rank[kept]] = value[kept]
    return np.stack([picked % columns, picked // columns], -1), heights


def _blur(maps: np.ndarray) -> np.ndarray:
    """3-tap binomial smoothing along both axes, the border repeated."""
    p = np.pad(maps, ((0, 0), (1, 1), (0, 0)), mode="edge")
    down = 0.25 * p[:, :-2] + 0.5 * p[:, 1:-1] + 0.25 * p[:, 2:]
    p = np.pad(down, ((0, 0), (0, 0), (1, 1)), mode="edge")
    return 0.25 * p[:, :, :-2] + 0.5 * p[:, :, 1:-1] + 0.25 * p[:, :, 2:]


def _refine(smooth: np.ndarray, peak: np.ndarray) -> np.ndarray:
    """(P, 2) float32 cells: one Newton step on the logarithm from the highest cell, at most one cell long."""
    joints, rows, columns = smooth.shape
    x = np.clip(peak[:, 0], 1, columns - 2)
    y = np.clip(peak[:, 1], 1, rows - 2)
    j = np.arange(joints)[:, None, None]
    patch = smooth[j, (y[:, None] + [-1, 0, 1])[:, :, None], (x[:, None] + [-1, 0, 1])[:, None, :]]
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


def _spread(maps: np.ndarray, peak: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """(P, 3) cells^2: second moments about the joint within a window, less the trained width, at least 0."""
    joints, rows, columns = maps.shape
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    px, py = peak[:, :1] + steps, peak[:, 1:] + steps  # (P, n)
    inside = ((py >= 0) & (py < rows))[:, :, None] & ((px >= 0) & (px < columns))[:, None, :]
    j = np.arange(joints)[:, None, None]
    patch = maps[j, np.clip(py, 0, rows - 1)[:, :, None], np.clip(px, 0, columns - 1)[:, None, :]]
    top = maps[np.arange(joints), peak[:, 1], peak[:, 0]]
    weight = np.where(inside, np.maximum(patch - 0.05 * top[:, None, None], 0.0), 0.0)
    weight /= np.maximum(weight.sum(axis=(1, 2), keepdims=True), 1e-12)
    dx, dy = (px - xy[:, :1])[:, None, :], (py - xy[:, 1:])[:, :, None]
    xx = (weight * dx**2).sum(axis=(1, 2)) - _TRAINED_SIGMA**2
    yy = (weight * dy**2).sum(axis=(1, 2)) - _TRAINED_SIGMA**2
    xy_ = (weight * dx * dy).sum(axis=(1, 2))
    xx, yy = np.maximum(xx, 0.0), np.maximum(yy, 0.0)
    xy_ = np.clip(xy_, -0.95 * np.sqrt(xx * yy), 0.95 * np.sqrt(xx * yy))
    return np.stack([xx, xy_, yy], -1).astype(np.float32)
