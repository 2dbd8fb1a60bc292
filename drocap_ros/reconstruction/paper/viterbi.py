"""Choice among the hypotheses of each frame over the whole sequence (dynamic programming, Viterbi 1967)."""

from __future__ import annotations

import numpy as np


def choose_path(cost: np.ndarray, poses: np.ndarray, switch_cost: float) -> np.ndarray:
    """Hypothesis (F,) int of each frame with the least total cost over the sequence.

    Parameters
    ----------
    cost : (H, F) of each hypothesis alone
    poses : (H, F, P, 3) camera axes
    switch_cost : weight of the squared distance between the poses of neighbouring frames
    """
    flat = np.swapaxes(poses.reshape(*cost.shape, -1), 0, 1)
    square = np.sum(flat * flat, axis=-1)
    cross = flat[:-1] @ np.swapaxes(flat[1:], 1, 2)
    change = switch_cost * np.maximum(square[:-1, :, None] + square[1:, None, :] - 2.0 * cross, 0.0)
    total, frames = cost[:, 0], cost.shape[1]
    came_from = np.zeros((frames, len(cost)), dtype=np.int64)
    for t in range(1, frames):
        sums = total[:, None] + change[t - 1]
        came_from[t] = np.argmin(sums, axis=0)
        total = np.min(sums, axis=0) + cost[:, t]
    path = np.empty(frames, dtype=np.int64)
    path[-1] = int(np.argmin(total))
    for t in range(frames - 1, 0, -1):
        path[t - 1] = came_from[t, path[t]]
    return path
