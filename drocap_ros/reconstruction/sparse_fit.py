"""Sparse combination of dictionary atoms under an orthographic camera, with temporal terms.

    min over C, R of  0.5 sum_t |W_t - R_t (sum_k c_tk B_k)|^2 + alpha |C|_1
                      + beta/2 sum |c_t+1 - c_t|^2 + gamma/2 sum |R_t+1 - R_t|^2

(Zhou et al. 2016, equation 9), alternating accelerated proximal gradient steps for C and downhill steps for R.
The mean pose enters as one more atom that costs nothing: its coefficient is the body's image scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.reconstruction.camera_update import update_rotations
from drocap_ros.reconstruction.config import InitializerConfig
from drocap_ros.reconstruction.data_term import Projection
from drocap_ros.reconstruction.dictionary import Dictionary, soft_threshold


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


def basis_matrix(dictionary: Dictionary) -> np.ndarray:
    """(1 + K, 3P): the mean pose and the atoms, flattened."""
    return np.concatenate([dictionary.mean[None], dictionary.atoms]).reshape(len(dictionary.atoms) + 1, -1)


def fit_sparse(
    projection: Projection,
    rotation: np.ndarray,
    coefficients: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig,
) -> SparseFit:
    """Refine starts over one block of frames.

    Parameters
    ----------
    rotation, coefficients : (F, 3, 3), (F, 1 + K) starts
    """
    basis = basis_matrix(dictionary)
    penalty = np.full(len(basis), config.sparsity)
    penalty[0] = 0.0
    # The mean pose spans the image, an atom moves a limb: precondition by the curvature of each.
    curvature = np.linalg.norm(basis @ basis.T, 2) * float(projection.information[..., [0, 2]].max())
    step = 1.0 / (curvature + 4.0 * config.coefficient_smoothness)
    c = coefficients
    for _ in range(config.sparse_rounds):
        ahead, t = c, 1.0
        for _ in range(config.sparse_iterations):
            gradient = sparse_gradient(projection, rotation, ahead, basis, config.coefficient_smoothness)
            new = soft_threshold(ahead - step * gradient, step * penalty)
            t_new = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
            ahead = new + ((t - 1.0) / t_new) * (new - c)
            # Gradient restart (O'Donoghue and Candes 2015): the momentum must not point uphill.
            if np.sum((ahead - new) * (new - c)) < 0.0:
                ahead, t_new = new, 1.0
            c, t = new, t_new
        shape = (c @ basis).reshape(len(c), -1, 3)
        rotation = update_rotations(projection, shape, rotation, steps=2, smoothness=config.rotation_smoothness)
    return SparseFit(c, rotation, (c @ basis).reshape(len(c), -1, 3))


def sparse_gradient(
    projection: Projection, rotation: np.ndarray, c: np.ndarray, basis: np.ndarray, smoothness: float
) -> np.ndarray:
    """(F, 1 + K) gradient of the smooth part of the objective by the coefficients."""
    shape = (c @ basis).reshape(len(c), -1, 3)
    _, slope = projection.value_and_gradient(shape, rotation)
    gradient = 0.5 * slope.reshape(len(c), -1) @ basis.T
    if smoothness > 0.0:
        change = smoothness * (c[1:] - c[:-1])
        gradient[1:] += change
        gradient[:-1] -= change
    return gradient
