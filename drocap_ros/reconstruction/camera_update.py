"""Update of the rotations R on SO(3) with the shapes held: Gauss-Newton steps that are taken only downhill."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.data_term import Projection, apply_information


def rotation_jacobian(x: np.ndarray) -> np.ndarray:
    """(..., P, 2, 3) derivative of the projection by a left rotation vector, for joints (..., P, 3) in camera axes."""
    zero = np.zeros_like(x[..., 0])
    row_x = np.stack([zero, x[..., 2], -x[..., 1]], axis=-1)
    row_y = np.stack([-x[..., 2], zero, x[..., 0]], axis=-1)
    return np.stack([row_x, row_y], axis=-2)


def rotation_gradient(projection: Projection, s: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(F, 3) derivative of each frame's reprojection cost by a left rotation vector, ``R <- exp(v) R``."""
    _, weighted = projection.residual(s, r)
    jacobian = rotation_jacobian(s @ np.swapaxes(r, 1, 2))
    return 2.0 * np.einsum("fpij,fpi->fj", jacobian, weighted)


def update_rotations(
    projection: Projection, s: np.ndarray, r: np.ndarray, *, steps: int = 1, smoothness: float = 0.0
) -> np.ndarray:
    """Rotations (F, 3, 3) of lower or equal cost: reprojection plus ``smoothness * rotation_change``.

    Parameters
    ----------
    s : (F, P, 3) shapes, held
    r : (F, 3, 3) present rotations
    """
    for _ in range(steps):
        pull = _neighbour_sum(r) if smoothness > 0.0 else None
        _, weighted = projection.residual(s, r)
        x = s @ np.swapaxes(r, 1, 2)
        # The translation follows the rotation; centring the joints by their information takes it out.
        jacobian = rotation_jacobian(x - _weighted_mean(x, projection.information))
        gradient = np.einsum("fpij,fpi->fj", jacobian, weighted)
        scaled = apply_information(projection.information[..., None, :], np.swapaxes(jacobian, -1, -2))
        hessian = np.einsum("fpij,fpki->fjk", jacobian, scaled)
        cost = projection.per_frame(s, r)
        if pull is not None:
            gradient = gradient - 2.0 * smoothness * _turning_moment(r, pull)
            hessian = hessian + 8.0 * smoothness * np.eye(3)
            cost = cost - 4.0 * smoothness * np.sum(r * pull, axis=(1, 2))
        trace = np.trace(hessian, axis1=1, axis2=2)
        hessian = hessian + (1e-4 * trace + 1e-9)[:, None, None] * np.eye(3)
        move = -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        # Halve the step where it climbs; a frame that still climbs stays where it is.
        undecided = np.ones(len(r), dtype=bool)
        for shrink in (1.0, 0.5, 0.25):
            turned = exp_so3(shrink * move) @ r
            new_cost = projection.per_frame(s, turned)
            if pull is not None:
                new_cost = new_cost - 4.0 * smoothness * np.sum(turned * pull, axis=(1, 2))
            take = undecided & (new_cost < cost)
            r = np.where(take[:, None, None], turned, r)
            undecided &= ~take
            if not undecided.any():
                break
    return r


def rotation_change(r: np.ndarray) -> float:
    """Sum over time of the squared chordal distance of neighbouring rotations (F, 3, 3)."""
    step = r[1:] - r[:-1]
    return float(np.sum(step * step))


def _neighbour_sum(r: np.ndarray) -> np.ndarray:
    """Sum of the mid-points to both neighbours.

    ``|a - b|^2 <= 2 |a - m|^2 + 2 |b - m|^2`` with m the present mid-point decouples the frames: each may then be
    updated by itself and the sum over time still falls.
    """
    middle = 0.5 * (r[1:] + r[:-1])
    total = np.zeros_like(r)
    total[1:] += middle
    total[:-1] += middle
    return total


def _turning_moment(r: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """(F, 3) derivative of ``<exp(v) R, M>`` by v at 0."""
    a = r @ np.swapaxes(pull, 1, 2)
    return np.stack([a[:, 1, 2] - a[:, 2, 1], a[:, 2, 0] - a[:, 0, 2], a[:, 0, 1] - a[:, 1, 0]], axis=-1)


def _weighted_mean(x: np.ndarray, information: np.ndarray) -> np.ndarray:
    weight = (information[..., 0] + information[..., 2])[..., None]
    return np.sum(weight * x, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
