"""Nuclear norm of the rearranged shape matrix S# and its proximal step.

Shapes are (3, P, F), frames last: S# is then the view ``s.reshape(3P, F)``, and elementwise operations run along
contiguous frames.
"""

from __future__ import annotations

import numpy as np


def nuclear_norm(s: np.ndarray) -> float:
    """Sum of the singular values of S#, for shapes (..., F)."""
    return float(_singular(s.reshape(-1, s.shape[-1]))[0].sum())


def singular_value_threshold(s: np.ndarray, tau: float) -> tuple[np.ndarray, float]:
    """Proximal step of ``tau * nuclear norm`` (Cai, Candes and Shen 2010) on shapes (..., F).

    Returns
    -------
    shapes (..., F) and the nuclear norm of the result
    """
    m = s.reshape(-1, s.shape[-1])
    sigma, u, wide = _singular(m)
    kept = np.maximum(sigma - tau, 0.0)
    shrink = (u * (kept / np.where(sigma > 0.0, sigma, 1.0))) @ u.T
    return (shrink @ m if wide else m @ shrink).reshape(s.shape), float(kept.sum())


def _singular(m: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Singular values and the vectors of the short side, from the Gram matrix: 3P is tens, F is hundreds."""
    wide = m.shape[0] <= m.shape[1]
    values, vectors = np.linalg.eigh(m @ m.T if wide else m.T @ m)
    return np.sqrt(np.maximum(values, 0.0)), vectors, wide
