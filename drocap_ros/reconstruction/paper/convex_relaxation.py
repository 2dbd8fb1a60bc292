"""Convex relaxation of the single-view problem by ADMM with mu = 1 (Zhou et al. 2015; 2016, section 3.3).

    min over M_k in R^(2 x 3) of  0.5 |W - sum_k M_k B_k|_F^2 + alpha sum_k |M_k|_2

needs no initial viewpoint; its solution gives rotation and coefficients.  Off by default, as it is slower and no
better than the viewpoint search; kept as the paper's own initializer.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import complete_rotation
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.paper.mf_nnm import fill_joints
from drocap_ros.reconstruction.paper.spectral_norm import shrink_spectral_norm


def convex_relaxation(
    w: np.ndarray,
    seen: np.ndarray,
    dictionary: Dictionary,
    *,
    alpha: float,
    iterations: int,
) -> np.ndarray:
    """Matrices M (F, 1 + K, 2, 3); the first belongs to the mean pose.

    Parameters
    ----------
    w : (F, P, 2) normalized; unseen joints are interpolated in time
    seen : (F, P) bool
    alpha : weight of the spectral norms
    """
    full = fill_joints(w, seen)
    full = full - full.mean(axis=1, keepdims=True)
    frames, p = full.shape[:2]
    basis = np.concatenate([dictionary.mean[None] / np.linalg.norm(dictionary.mean), dictionary.atoms])
    count = len(basis)
    b = np.swapaxes(basis, 1, 2).reshape(3 * count, p)
    target = np.swapaxes(full, 1, 2).reshape(2 * frames, p)
    # (B B^T + I)^-1 by Woodbury: P is 15 where 3 K is hundreds.
    small = np.linalg.inv(np.eye(p) + b.T @ b)
    moment = target @ b.T
    z = np.zeros((2 * frames, 3 * count))
    dual = np.zeros_like(z)
    for _ in range(iterations):
        right = moment + (z - dual)
        m = right - (right @ b) @ small @ b.T
        z = _split(_shrink(_join(m + dual, count), alpha))
        dual += m - z
    out = _join(z, count)
    out[:, 0] /= np.linalg.norm(dictionary.mean)
    return out


def rotation_and_coefficients(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (F, 3, 3) torso -> camera, and coefficients (F, 1 + K), from matrices M (F, 1 + K, 2, 3).

    The rotation is the closest orthonormal rows to the mean pose's matrix, which has most of the norm.
    """
    rotation = complete_rotation(m[:, 0] + 1e-9 * np.eye(2, 3))
    coefficients = 0.5 * np.einsum("fkij,fij->fk", m, rotation[:, :2])
    return rotation, coefficients


def _join(flat: np.ndarray, count: int) -> np.ndarray:
    """(2F, 3K) to (F, K, 2, 3)."""
    return flat.reshape(-1, 2, count, 3).transpose(0, 2, 1, 3)


def _split(m: np.ndarray) -> np.ndarray:
    """(F, K, 2, 3) to (2F, 3K)."""
    return m.transpose(0, 2, 1, 3).reshape(2 * len(m), -1)


def _shrink(m: np.ndarray, tau: float) -> np.ndarray:
    """Spectral norms shrink, that of the mean pose a tenth as much: every pose contains it."""
    out = shrink_spectral_norm(m, tau)
    out[:, 0] = shrink_spectral_norm(m[:, 0], 0.1 * tau)
    return out
