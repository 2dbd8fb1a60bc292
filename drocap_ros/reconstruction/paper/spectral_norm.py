"""Proximal step of the spectral norm of 2 x 3 matrices, in closed form (Zhou et al. 2015, section 4).

The convex relaxation replaces coefficient times rotation by a free 2 x 3 matrix per atom; its spectral norm is
the tightest convex surrogate for "a scaled pair of orthonormal rows".
"""

from __future__ import annotations

import numpy as np


def singular_values(m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both singular values (...), larger first, of matrices (..., 2, 3)."""
    a = np.einsum("...j,...j->...", m[..., 0, :], m[..., 0, :])
    d = np.einsum("...j,...j->...", m[..., 1, :], m[..., 1, :])
    b = np.einsum("...j,...j->...", m[..., 0, :], m[..., 1, :])
    middle, spread = 0.5 * (a + d), np.hypot(0.5 * (a - d), b)
    return np.sqrt(middle + spread), np.sqrt(np.maximum(middle - spread, 0.0))


def shrink_spectral_norm(m: np.ndarray, tau: float) -> np.ndarray:
    """Proximal step of ``tau * sum of spectral norms`` on matrices (..., 2, 3).

    The largest singular values decrease by ``tau`` in total.
    """
    s1, s2 = singular_values(m)
    level = np.where(s1 - s2 >= tau, s1 - tau, np.maximum(0.5 * (s1 + s2 - tau), 0.0))
    return _scale_singular_values(m, s1, s2, np.minimum(s1, level), np.minimum(s2, level))


def _scale_singular_values(
    m: np.ndarray, s1: np.ndarray, s2: np.ndarray, new1: np.ndarray, new2: np.ndarray
) -> np.ndarray:
    """Replace the singular values: ``(p I + q M M^T) M`` with p, q from the two pairs of values."""
    g1 = new1 / np.where(s1 > 0.0, s1, 1.0)
    g2 = np.where(s2 > 1e-12 * s1, new2 / np.where(s2 > 0.0, s2, 1.0), g1)
    gap = s1 * s1 - s2 * s2
    apart = gap > 1e-12 * s1 * s1
    q = np.where(apart, (g1 - g2) / np.where(apart, gap, 1.0), 0.0)
    p = g1 - q * s1 * s1
    gram = m @ np.swapaxes(m, -1, -2)
    return p[..., None, None] * m + q[..., None, None] * (gram @ m)
