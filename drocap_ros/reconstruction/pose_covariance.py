"""Uncertainty of a single-view pose: Laplace approximation of the dense model's posterior."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.camera_update import rotation_jacobian
from drocap_ros.reconstruction.config import InitializerConfig
from drocap_ros.reconstruction.data_term import apply_information
from drocap_ros.reconstruction.dictionary import Dictionary


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
    turn = np.concatenate([rotation_jacobian(x), _depth_row(x)], axis=-2)
    bend = np.einsum("fij,kpj->fpik", rotation, basis)
    jac = np.concatenate([turn, bend], axis=-1)
    flat = jac[..., :2, :]
    weight = information[..., 0][..., None, None]
    flat = flat - np.sum(weight * flat, axis=1, keepdims=True) / np.maximum(weight.sum(1, keepdims=True), 1e-12)
    scaled = apply_information(information[..., None, :] / config.keypoint_std**2, np.swapaxes(flat, -1, -2))
    hessian = np.einsum("fpia,fpbi->fab", flat, scaled)
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


def _depth_row(x: np.ndarray) -> np.ndarray:
    """(..., P, 1, 3) derivative of the depth by a left rotation vector."""
    return np.stack([x[..., 1], -x[..., 0], np.zeros_like(x[..., 0])], axis=-1)[..., None, :]
