"""Signs of the bones' depth differences, decided over the whole sequence.

Under a distant camera a bone of length L reaches sqrt(L^2 - l^2) in depth, l its length in the image; a single image
leaves the sign open.  Over time the sign changes only where the bone is parallel to the image, and the bone then
swings through at constant speed instead of bouncing back.  The signs of a bone are the cheapest path through the
sequence.
"""

from __future__ import annotations

import numpy as np


def depth_signs(
    reach: np.ndarray,
    depth: np.ndarray,
    sigma: np.ndarray,
    speed: float,
    acceleration: float,
) -> np.ndarray:
    """Most plausible signs of depth differences, by dynamic programming over pairs of frames.

    Parameters
    ----------
    reach : (F, L) >= 0, depth difference of bone l without its sign
    depth, sigma : (F, L) the lifter's depth difference and its expected absolute error
    speed, acceleration : first and second difference of the depth per frame that cost as much as one sigma

    Returns
    -------
    (F, L) of +1 and -1
    """
    frames, bones = reach.shape
    signs: np.ndarray = np.array([1.0, -1.0])
    state = signs * reach[..., None]
    unary = np.abs(state - depth[..., None]) / sigma[..., None]
    if frames == 1:
        only: np.ndarray = signs[unary[0].argmin(axis=-1)][None]
        return only
    move = np.abs(state[1:, :, None, :] - state[:-1, :, :, None]) / speed
    swing = state[2:, :, None, None, :] - 2 * state[1:-1, :, None, :, None] + state[:-2, :, :, None, None]
    # The bound keeps a gross error of the image length from turning the signs of the rest of the sequence.
    swing = np.minimum(np.abs(swing) / acceleration, 4.0)
    cost = unary[0][:, :, None] + unary[1][:, None, :] + move[0]
    back = np.zeros((frames, bones, 2, 2), np.int8)
    for t in range(2, frames):
        total = cost[:, :, :, None] + swing[t - 2]
        keep = total[:, 0] <= total[:, 1]
        back[t] = ~keep
        cost = np.where(keep, total[:, 0], total[:, 1]) + (move[t - 1] + unary[t][:, None, :])
    path = np.zeros((frames, bones), np.intp)
    last = cost.reshape(bones, 4).argmin(axis=1)
    path[-1], path[-2] = last % 2, last // 2
    each = np.arange(bones)
    for t in range(frames - 1, 1, -1):
        path[t - 2] = back[t, each, path[t - 1], path[t]]
    return signs[path]
