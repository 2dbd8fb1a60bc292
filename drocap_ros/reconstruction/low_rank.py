"""Nuclear norm of the rearranged shape matrix S# and its proximal step."""

from __future__ import annotations

import numpy as np


def rearrange(s: np.ndarray) -> np.ndarray:
    """S# as (F, 3P): row t is the vectorized shape of frame t (the transpose of the paper's, same norm)."""
    return s.reshape(len(s), -1)


def nuclear_norm(s: np.ndarray) -> float:
    """Sum of the singular values of S# for shapes (F, P, 3)."""
    return float(_singular(rearrange(s))[0].sum())


def singular_value_threshold(s: np.ndarray, tau: float) -> tuple[np.ndarray, float]:
    """Proximal step of ``tau * nuclear norm`` (Cai, Candes and Shen 2010) on shapes (F, P, 3).

    Returns
    -------
    shapes (F, P, 3) and the nuclear norm of the result
    """
    m = rearrange(s)
    sigma, v, tall = _singular(m)
    kept = np.maximum(sigma - tau, 0.0)
    factor = kept / np.where(sigma > 0.0, sigma, 1.0)
    shrink = (v * factor) @ v.T
    return (m @ shrink if tall else shrink @ m).reshape(s.shape), float(kept.sum())


def _singular(m: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Singular values and the vectors of the short side, from the Gram matrix: 3P is tens, F is hundreds."""
    tall = m.shape[0] >= m.shape[1]
    values, vectors = np.linalg.eigh(m.T @ m if tall else m @ m.T)
    return np.sqrt(np.maximum(values, 0.0)), vectors, tall
