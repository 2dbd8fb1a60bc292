"""2D keypoints of one person with their uncertainty: the one type that perception hands to reconstruction."""

from __future__ import annotations

from dataclasses import dataclass, replace

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

    def __getitem__(self, frames: slice | np.ndarray | None) -> Keypoints2D:
        """The keypoints of some frames; ``frames`` indexes the leading axis as it does in numpy."""
        return replace(self, **{name: value[frames] for name, value in vars(self).items() if value is not None})

    def with_joints(self, count: int) -> Keypoints2D:
        """The first ``count`` joints of a body set; those that it lacks are not seen."""
        added = max(count - self.xy.shape[-2], 0)

        def fit(values: np.ndarray, unknown: float) -> np.ndarray:
            # The joints are the axis before the columns; confidences have none.
            axis = self.xy.ndim - 2
            width = [(0, added if i == axis else 0) for i in range(values.ndim)]
            kept = (*[slice(None)] * axis, slice(count))
            return np.pad(values, width, constant_values=unknown)[kept]

        return Keypoints2D(
            fit(self.xy, np.nan),
            None if self.confidence is None else fit(self.confidence, 0.0),
            None if self.covariance is None else fit(self.covariance, np.nan),
        )

    def without_joints(self, count: int) -> Keypoints2D:
        """The joints after the first ``count``."""
        later = slice(count, None)
        return Keypoints2D(
            self.xy[..., later, :],
            None if self.confidence is None else self.confidence[..., later],
            None if self.covariance is None else self.covariance[..., later, :],
        )

    @property
    def seen(self) -> np.ndarray:
        """(F, P) bool, both coordinates are finite."""
        return np.asarray(np.isfinite(self.xy).all(axis=-1))

    @property
    def weights(self) -> np.ndarray:
        """(F, P) confidence of the seen joints, 1 without one; 0 where not seen."""
        return np.where(self.seen, 1.0 if self.confidence is None else np.nan_to_num(self.confidence), 0.0)

    @property
    def variance(self) -> np.ndarray | None:
        """(F, P) px^2 per coordinate, the mean of xx and yy; None without a covariance."""
        return None if self.covariance is None else 0.5 * (self.covariance[..., 0] + self.covariance[..., 2])
