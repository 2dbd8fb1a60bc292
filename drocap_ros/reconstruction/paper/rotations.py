"""Update of the rotations R on SO(3) for fixed shapes: Gauss-Newton steps that only lower the cost.

Shapes are (3, P, F) and rotations (3, 3, F), frames last.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.paper.reprojection import Projection, rotate


def update_rotations(
    projection: Projection, s: np.ndarray, r: np.ndarray, *, steps: int = 1, smoothness: float = 0.0
) -> np.ndarray:
    """Rotations (3, 3, F) of lower or equal cost.

    s : (3, P, F) shapes, fixed
    r : (3, 3, F) present rotations
    smoothness : weight of the squared chordal distances of neighbouring rotations
    """
    for _ in range(steps):
        x = rotate(r, s)
        gap = projection.residual(s, r)
        weighted = projection.inform(gap)
        cost = np.einsum("ipf,ipf->f", gap, weighted)
        # The translation follows the rotation; centring the joints by their weights takes it out.
        x -= np.einsum("pf,ipf->if", projection.share, x)[:, None]
        gradient, hessian = _moment(x, weighted), _hessian(x, projection.information)
        pull = _neighbour_sum(r) if smoothness > 0.0 else None
        if pull is not None:
            gradient -= 2.0 * smoothness * _turning_moment(r, pull)
            hessian += 8.0 * smoothness * np.eye(3)
            cost -= 4.0 * smoothness * np.einsum("ijf,ijf->f", r, pull)
        trace = np.trace(hessian, axis1=1, axis2=2)
        hessian += (1e-4 * trace + 1e-9)[:, None, None] * np.eye(3)
        move = -np.linalg.solve(hessian, gradient.T[..., None])[..., 0]
        # Halve the step where the cost rises; a frame whose cost still rises keeps its rotation.
        undecided = np.ones(r.shape[2], dtype=bool)
        for shrink in (1.0, 0.5, 0.25):
            turned = turn(r, shrink * move)
            new_cost = projection.per_frame(s, turned)
            if pull is not None:
                new_cost -= 4.0 * smoothness * np.einsum("ijf,ijf->f", turned, pull)
            take = undecided & (new_cost < cost)
            r = np.where(take, turned, r)
            undecided &= ~take
            if not undecided.any():
                break
    return r


def turn(r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """``exp(v) R`` for rotations (3, 3, F) and rotation vectors (F, 3)."""
    e = np.moveaxis(exp_so3(v), 0, -1)
    return np.stack([e[i, 0] * r[0] + e[i, 1] * r[1] + e[i, 2] * r[2] for i in range(3)])


def _moment(x: np.ndarray, force: np.ndarray) -> np.ndarray:
    """(3, F) sum over joints of x cross force, for joints (3, P, F) and forces (2, P, F) in the image plane."""
    return np.stack(
        [
            -np.einsum("pf,pf->f", x[2], force[1]),
            np.einsum("pf,pf->f", x[2], force[0]),
            np.einsum("pf,pf->f", x[0], force[1]) - np.einsum("pf,pf->f", x[1], force[0]),
        ]
    )


def _hessian(x: np.ndarray, information: np.ndarray) -> np.ndarray:
    """(F, 3, 3) Gauss-Newton matrix; the rows of the Jacobian are (0, z, -y) and (-z, 0, x)."""
    xx, xy, yy = information
    h = np.empty((x.shape[2], 3, 3))
    along, across = xy * x[1] - yy * x[0], xy * x[0] - xx * x[1]
    h[:, 0, 0] = np.einsum("pf,pf,pf->f", yy, x[2], x[2])
    h[:, 1, 1] = np.einsum("pf,pf,pf->f", xx, x[2], x[2])
    h[:, 0, 1] = h[:, 1, 0] = -np.einsum("pf,pf,pf->f", xy, x[2], x[2])
    h[:, 0, 2] = h[:, 2, 0] = np.einsum("pf,pf->f", x[2], along)
    h[:, 1, 2] = h[:, 2, 1] = np.einsum("pf,pf->f", x[2], across)
    h[:, 2, 2] = -np.einsum("pf,pf->f", x[1], across) - np.einsum("pf,pf->f", x[0], along)
    return h


def _neighbour_sum(r: np.ndarray) -> np.ndarray:
    """Sum of the mid-points to both neighbours.

    ``|a - b|^2 <= 2 |a - m|^2 + 2 |b - m|^2`` with m the present mid-point decouples the frames: separate updates
    still lower the sum over time.
    """
    middle = 0.5 * (r[..., 1:] + r[..., :-1])
    total = np.zeros_like(r)
    total[..., 1:] += middle
    total[..., :-1] += middle
    return total


def _turning_moment(r: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """(3, F) derivative of ``<exp(v) R, M>`` by v at 0."""
    a = np.einsum("ikf,jkf->ijf", r, pull)
    return np.stack([a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0]])
