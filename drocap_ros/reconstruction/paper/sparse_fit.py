"""Sparse combination of dictionary atoms under an orthographic camera, with temporal terms.

    min over C, R of  0.5 sum_t |W_t - R_t (sum_k c_tk B_k)|^2 + alpha |C|_1
                      + beta/2 sum |c_t+1 - c_t|^2 + gamma/2 sum |R_t+1 - R_t|^2

(Zhou et al. 2016, equation 9), alternating accelerated proximal gradient steps for C and decreasing steps for R.
The mean pose is one more atom without a penalty: its coefficient is the body's image scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary, soft_threshold
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first
from drocap_ros.reconstruction.paper.rotations import update_rotations


@dataclass(frozen=True)
class SparseFit:
    """Poses as sparse combinations.

    coefficients : (F, 1 + K); the first is that of the mean pose
    rotation : (F, 3, 3) torso -> camera
    shape : (F, P, 3) torso frame, in the unit of the 2D joints
    """

    coefficients: np.ndarray
    rotation: np.ndarray
    shape: np.ndarray


def fit_sparse(
    projection: Projection,
    rotation: np.ndarray,
    coefficients: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig,
) -> SparseFit:
    """Refine initial poses over one block of frames.

    Parameters
    ----------
    rotation, coefficients : (F, 3, 3), (F, 1 + K) initial values
    """
    basis = dictionary.basis
    penalty = np.full((len(basis), 1), config.sparsity)
    penalty[0] = 0.0
    curvature = dictionary.curvature * float(projection.information[[0, 2]].max())
    step = 1.0 / (curvature + 4.0 * config.coefficient_smoothness)
    c, r = np.ascontiguousarray(coefficients.T), np.ascontiguousarray(np.moveaxis(rotation, 0, -1))
    for _ in range(config.sparse_rounds):
        ahead, t = c, 1.0
        for _ in range(config.sparse_iterations):
            gradient = sparse_gradient(projection, r, ahead, basis, config.coefficient_smoothness)
            new = soft_threshold(ahead - step * gradient, step * penalty)
            t_new = 0.5 * (1.0 + float(np.sqrt(1.0 + 4.0 * t * t)))
            move = new - c
            # Gradient restart (O'Donoghue and Candes 2015): the momentum must not point uphill.
            if np.vdot(ahead - new, move) > 0.0:
                ahead, t_new = new, 1.0
            else:
                ahead = new + ((t - 1.0) / t_new) * move
            c, t = new, t_new
        r = update_rotations(projection, _shapes(basis, c), r, steps=2, smoothness=config.rotation_smoothness)
    return SparseFit(c.T, np.ascontiguousarray(np.moveaxis(r, -1, 0)), frames_first(_shapes(basis, c)))


def sparse_gradient(
    projection: Projection, r: np.ndarray, c: np.ndarray, basis: np.ndarray, smoothness: float
) -> np.ndarray:
    """(1 + K, F) gradient of the smooth part by the coefficients (1 + K, F), for rotations (3, 3, F)."""
    _, slope = projection.value_and_gradient(_shapes(basis, c), r)
    gradient: np.ndarray = 0.5 * (basis @ slope.reshape(basis.shape[1], -1))
    if smoothness > 0.0:
        change = smoothness * (c[:, 1:] - c[:, :-1])
        gradient[:, 1:] += change
        gradient[:, :-1] -= change
    return gradient


def _shapes(basis: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(3, P, F) shapes of coefficients (1 + K, F)."""
    shapes: np.ndarray = (basis.T @ c).reshape(3, -1, c.shape[1])
    return shapes
