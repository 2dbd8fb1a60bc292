"""2D keypoints of one person with their uncertainty: the one type that perception hands to reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Keypoints2D:
    """Keypoints of one person over F images, P joints; arrays of a single image lack the leading axis.

    xy : (F, P, 2) px, x right, y down; NaN = not seen
    confidence : (F, P) in [0, 1], or None
    covariance : (F, P, 3) px^2, xx xy yy, or None
    """

    xy: np.ndarray
    confidence: np.ndarray | None = None
    covariance: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, frames: Any) -> Keypoints2D:
        """The keypoints of some frames; ``frames`` indexes the leading axis as it does in numpy."""
        return replace(self, **{name: value[frames] for name, value in vars(self).items() if value is not None})

    @property
    def seen(self) -> np.ndarray:
        """(F, P) bool, both coordinates are finite."""
        return np.isfinite(self.xy).all(axis=-1)

    @property
    def weights(self) -> np.ndarray:
        """(F, P) confidence of the seen joints, 1 without one; 0 where not seen."""
        return np.where(self.seen, 1.0 if self.confidence is None else np.nan_to_num(self.confidence), 0.0)

    @property
    def variance(self) -> np.ndarray | None:
        """(F, P) px^2 per coordinate, the mean of xx and yy; None without a covariance."""
        return None if self.covariance is None else 0.5 * (self.covariance[..., 0] + self.covariance[..., 2])


def isotropic_covariance(variance: np.ndarray) -> np.ndarray:
    """(..., 3) xx xy yy of variances (...) that both coordinates share."""
    return np.stack([variance, np.zeros_like(variance), variance], axis=-1)
