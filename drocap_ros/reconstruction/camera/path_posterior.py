"""Covariances of a camera's path after the adjustment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.reconstruction.camera.path_equations import PathEquations
from drocap_ros.reconstruction.camera.path_model import ATTITUDE_LATENCY, KNOT, MISALIGNMENT, POSITION_LATENCY, SHARED
from drocap_ros.reconstruction.camera.path_residuals import PathResiduals
from drocap_ros.reconstruction.common.banded import backward, band_factor, forward


class Posterior(NamedTuple):
    """Covariances of K knots, position (m) and rotation (rad, camera axes).

    shared : (SHARED, SHARED) of the shared unknowns
    knots : (K, 6, 6) of the errors
    steps : (K - 1, 6, 6) of the change of the errors from knot to knot
    pose : (K, 6, 6) of the corrected camera: errors and shared unknowns together
    """

    shared: np.ndarray
    knots: np.ndarray
    steps: np.ndarray
    pose: np.ndarray


def posterior_of(r: PathResiduals) -> Posterior | None:
    """Covariances at the solution; None = not positive definite."""
    equations = PathEquations(r)
    factor = band_factor(equations.band.copy())
    if factor is None:
        return None
    y = forward(factor, equations.border)
    try:
        inverse = np.linalg.inv(np.linalg.cholesky(equations.corner - y.T @ y))
    except np.linalg.LinAlgError:
        return None
    shared = inverse.T @ inverse
    knots, beside = _blocks(factor)
    lever = backward(factor, y).reshape(len(knots), KNOT, -1)
    total = _by_shared(r) - lever
    pose = knots + total @ shared @ np.swapaxes(total, 1, 2)
    knots = knots + lever @ shared @ np.swapaxes(lever, 1, 2)
    beside = beside + lever[:-1] @ shared @ np.swapaxes(lever[1:], 1, 2)
    steps = knots[1:] + knots[:-1] - beside - np.swapaxes(beside, 1, 2)
    # Half of the squared lengths of pairs with a standard deviation of 1 are below 1.39.
    noise = float(np.median(r.square)) / 1.39
    scale = r.data.config.views_per_fact * max(noise, 1e-12)
    return Posterior(scale * shared, scale * knots, scale * steps, scale * pose)


def _by_shared(r: PathResiduals) -> np.ndarray:
    """(K, 6, SHARED) derivatives of the corrected pose at the knots by the shared unknowns."""
    frame = r.data.knots.frame
    out = np.zeros((len(frame), KNOT, SHARED))
    out[:, 3:, MISALIGNMENT] = np.eye(3)
    out[:, 3:, ATTITUDE_LATENCY] = r.turn_rate[frame]
    out[:, :3, POSITION_LATENCY] = r.velocity[frame]
    out[..., ~r.weights.free] = 0.0
    return out


def _blocks(factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 6, 6) diagonal blocks of the inverse of a band, and (K - 1, 6, 6) beside them, from its Cholesky factor.

    Source: Takahashi, Fagan, Chin 1973, by blocks as wide as the band: only what the band couples is computed.
    """
    from scipy.linalg import solve_triangular

    width, size = factor.shape
    count = -(-size // width)
    lower = np.zeros((count, width, 2 * width))
    row = np.arange(width)
    for i in range(width):  # element [d, c] of the factor couples column c with row c + d
        columns = np.arange(i, size, width)
        lower[np.arange(len(columns))[:, None], i, i + row] = factor[:, columns].T
    if size % width:
        fill = np.arange(size % width, width)
        lower[-1, fill, fill] = 1.0
    knots, beside = np.empty((count * width, KNOT)), np.empty((count * width, KNOT))
    later = np.zeros((width, width))
    for block in range(count - 1, -1, -1):
        own, coupling = lower[block, :, :width].T, lower[block, :, width:].T
        inverse = solve_triangular(own, np.eye(width), lower=True)
        down = coupling @ inverse
        off = -later @ down
        here = inverse.T @ inverse - down.T @ off
        here = 0.5 * (here + here.T)
        for at in range(0, width, KNOT):
            rows = slice(block * width + at, block * width + at + KNOT)
            knots[rows] = here[at : at + KNOT, at : at + KNOT]
            inside = at + KNOT < width
            next_rows = here[at + KNOT : at + 2 * KNOT] if inside else off[:KNOT]
            beside[rows] = next_rows[:, at : at + KNOT].T
        later = here
    return knots[:size].reshape(-1, KNOT, KNOT), beside[: size - KNOT].reshape(-1, KNOT, KNOT)
