"""Covariances as ellipsoids."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import quaternion_from_matrix

#: Least squared half axis: smaller ones are invisible.
_SMALLEST_M2 = 1e-8


def unpack_covariance(packed: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., 3, 3) of xx xy xz yy yz zz (..., 6)."""
    return packed[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*packed.shape[:-1], 3, 3)


def pack_covariance(matrix: np.ndarray) -> np.ndarray:
    """Elements xx xy xz yy yz zz (..., 6) of symmetric matrices (..., 3, 3)."""
    packed: np.ndarray = matrix[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return packed


def ellipsoids(covariance: np.ndarray, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
    """Orientation (N, 4) x y z w and half axes (N, 3) m of the ellipsoids of covariances (N, 3, 3) m^2."""
    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1.0  # a rotation, not a reflection
    return quaternion_from_matrix(axes), sigmas * np.sqrt(np.maximum(variances, _SMALLEST_M2))
