"""Uncertainty of a single-view pose: Laplace approximation of the dense model's posterior."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import hat
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.reconstruction_config import InitializerConfig


def pose_covariance(
    information: np.ndarray,
    rotation: np.ndarray,
    coefficients: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig,
) -> np.ndarray:
    """Covariance (F, P, 3, 3) of each joint in camera axes, about the pelvis, in squared units of the 2D joints.

    Parameters
    ----------
    information : (F, P, 3); 1, 0, 1 stands for a joint of standard deviation ``config.keypoint_std``
    rotation, coefficients : (F, 3, 3), (F, 1 + D) of the dense fit
    """
    size = coefficients.shape[1] - 1
    basis = np.concatenate([dictionary.mean[None], dictionary.components[:size]])
    scale = np.maximum(np.abs(coefficients[:, :1]), 1e-6)
    shapes = np.einsum("fk,kpi->fpi", coefficients, basis)
    x = shapes @ np.swapaxes(rotation, 1, 2)
    # Derivative of the camera-frame joints by rotation (3) and coefficients (1 + D).
    turn = -hat(x)
    bend = np.einsum("fij,kpj->fpik", rotation, basis)
    jac = np.concatenate([turn, bend], axis=-1)
    flat = jac[..., :2, :]
    weight = information[..., 0][..., None, None]
    flat = flat - np.sum(weight * flat, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    matrix = information[..., [[0, 1], [1, 2]]] / config.keypoint_std**2
    hessian = np.einsum("fpia,fpib->fab", flat, matrix @ flat)
    prior = np.concatenate(
        [np.ones((len(x), 3)), 1.0 / (config.scale_std * scale), 1.0 / (scale * dictionary.component_std[:size])], 1
    )
    hessian += prior[:, :, None] ** 2 * np.eye(prior.shape[1])
    about_pelvis = jac - jac[:, :1]
    return about_pelvis @ np.linalg.inv(hessian)[:, None] @ np.swapaxes(about_pelvis, -1, -2)


def packed_covariance(covariance: np.ndarray) -> np.ndarray:
    """(..., 6) xx xy xz yy yz zz of matrices (..., 3, 3)."""
    rows, columns = np.triu_indices(3)
    return covariance[..., rows, columns]
