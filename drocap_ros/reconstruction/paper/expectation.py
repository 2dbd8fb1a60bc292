"""E-step over uncertain 2D joints (Zhou et al. 2016, section 4): one Gaussian per joint and a share of gross outliers.

All quantities are in the solvers' normalized units; information 1, 0, 1 is an ordinary joint.
"""

from __future__ import annotations

import numpy as np

#: Area over which gross outliers are uniform, squared 2D std: about that of the person's box.
OUTLIER_AREA = 12.0


def expected_information(
    w: np.ndarray, information: np.ndarray, projected: np.ndarray, std: float, *, outlier_share: float = 0.05
) -> np.ndarray:
    """Information (F, P, 3) times the probability that the joint is no outlier, given the model's joints.

    Parameters
    ----------
    w, information : (F, P, 2), (F, P, 3), 0 where not seen
    projected : (F, P, 2) the model's joints in the image
    std : standard deviation of an ordinary joint about the model
    outlier_share : prior probability of an outlier
    """
    fit = _log_density(projected - w, information / std**2)
    inlier = _share(fit + np.log1p(-outlier_share), np.log(outlier_share / OUTLIER_AREA))
    expected: np.ndarray = information * inlier[..., None]
    return expected


def _log_density(gap: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Log of the Gaussian density of gaps (..., 2) under information (..., 3)."""
    xx, xy, yy = np.moveaxis(information, -1, 0)
    det = np.maximum(xx * yy - xy * xy, 1e-300)
    x, y = gap[..., 0], gap[..., 1]
    density: np.ndarray = 0.5 * np.log(det) - np.log(2.0 * np.pi) - 0.5 * (xx * x * x + 2.0 * xy * x * y + yy * y * y)
    return density


def _share(log_a: np.ndarray, log_b: float) -> np.ndarray:
    """``a / (a + b)`` from logarithms."""
    return 1.0 / (1.0 + np.exp(np.clip(log_b - log_a, -700.0, 700.0)))
