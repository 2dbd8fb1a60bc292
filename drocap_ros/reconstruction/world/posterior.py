"""Posterior covariances from the normal equations: selected inversion of their band, and the shared unknowns' part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.reconstruction.common.banded import backward, band_factor, forward
from drocap_ros.reconstruction.world.world_model import JOINTS, SCALE, WorldState


class Posterior(NamedTuple):
    """Covariances at a unit variance of every residual.

    place : (3, 3) m^2 of the mean place of all joints of all frames, in the world
    joints : (F, 17, 3, 3) m^2 about it; shared : of the shared unknowns
    """

    place: np.ndarray
    joints: np.ndarray
    shared: np.ndarray


def posterior(matrix: tuple[np.ndarray, np.ndarray, np.ndarray], state: WorldState) -> Posterior | None:
    """Covariances from the band, border and corner of :func:`normal_matrix`; None = not positive definite."""
    band, border, corner = matrix
    factor = band_factor(band)
    if factor is None:
        return None
    half = forward(factor, border)
    by_shared = backward(factor, half)
    try:
        shared = np.linalg.inv(corner - half.T @ half)
    except np.linalg.LinAlgError:
        return None
    frames, scale = len(state.joints), float(state.globals[SCALE])
    cameras, shared_size = state.camera.shape[1], border.shape[1]
    lever = by_shared.reshape(frames, -1, shared_size)[:, cameras:].reshape(frames, JOINTS, 3, -1) / scale
    lever[..., SCALE] += state.joints / scale**2
    joints = np.empty((frames, JOINTS, 3, 3))
    blocks = _diagonal_blocks(factor, frames)
    for joint in range(JOINTS):
        at = slice(cameras + 3 * joint, cameras + 3 * joint + 3)
        joints[:, joint] = blocks[:, at, at] / scale**2
    weighted = (lever.reshape(-1, shared_size) @ shared).reshape(lever.shape)
    joints += weighted @ np.swapaxes(lever, -1, -2)
    with_place = _with_place(factor, shared, lever, scale)
    place = with_place.mean(axis=(0, 1))
    return Posterior(place, joints - with_place - np.swapaxes(with_place, -1, -2) + place, shared)


def _with_place(factor: np.ndarray, shared: np.ndarray, lever: np.ndarray, scale: float) -> np.ndarray:
    """(F, 17, 3, 3) m^2 covariance of the joints with their mean place.

    lever : (F, 17, 3, N) of the joints by the shared unknowns, with the sign turned
    """
    frames = len(lever)
    mean = np.zeros((frames, factor.shape[1] // frames, 3))
    mean[:, -3 * JOINTS :] = np.tile(np.eye(3), (JOINTS, 1)) / (frames * JOINTS * scale)
    own = backward(factor, forward(factor, mean.reshape(-1, 3))).reshape(mean.shape)[:, -3 * JOINTS :] / scale
    by_shared = shared @ lever.mean(axis=(0, 1)).T
    return np.asarray(own.reshape(frames, JOINTS, 3, 3) + lever @ by_shared)


def _diagonal_blocks(factor: np.ndarray, frames: int) -> np.ndarray:
    """(F, N, N) blocks of the inverse of a band, from its Cholesky factor, last frame first.

    Source: Takahashi, Fagan, Chin 1973, by blocks: of the inverse only what the band couples is computed.  The blocks
    are sums of squares, so single precision, which takes half the time, keeps four digits of them.
    """
    from scipy.linalg import get_lapack_funcs

    width, size = len(factor), factor.shape[1] // frames
    columns = np.zeros((frames, 3 * size, size), np.float32)
    by_frame = factor.reshape(width, frames, size)
    for i in range(size):
        columns[:, i : i + width, i] = by_frame[:, :, i].T
    invert = get_lapack_funcs("trtri", (columns,))
    # NumPy's batched inverse knows no triangles: three times as long.
    inverse = np.stack([invert(triangle, lower=1)[0] for triangle in columns[:, :size]])
    coupling = columns[:, size:] @ inverse
    own = np.swapaxes(inverse, 1, 2) @ inverse
    out = np.empty((frames, size, size))
    later, before = np.zeros((2, 2 * size, 2 * size), np.float32)
    for frame in range(frames - 1, -1, -1):
        off = -later @ coupling[frame]
        block = own[frame] - coupling[frame].T @ off
        out[frame] = 0.5 * (block + block.T)  # rounding of the skew part would grow from frame to frame
        before[:size, :size], before[size:, size:] = out[frame], later[:size, :size]
        before[size:, :size], before[:size, size:] = off[:size], off[:size].T
        later, before = before, later
    return out
