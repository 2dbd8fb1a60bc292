"""Calibrated keypoints of one body in one image."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.skeleton import BODY_15

#: Least confidence of a joint that counts.
_SEEN = 0.3
#: Median distance of the joints of two poses below which they are one person's, share of the body's longer extent.
_SAME = 0.05


class BodyPose(NamedTuple):
    """Joints that the network gives, ``BODY_15`` first: (P, 2) px, (P, 3) px^2, (P,)."""

    xy: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray

    @property
    def mean_confidence(self) -> float:
        """Over ``BODY_15``: the thresholds hold for networks with and without feet."""
        return float(self.confidence[: len(BODY_15)].mean())

    def extent(self, least: float = _SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the joints; None when fewer than a share of ``BODY_15`` are seen with the least confidence."""
        seen = self.confidence[: len(BODY_15)] >= least
        if seen.sum() < share * len(seen):
            return None
        xy = self.xy[: len(BODY_15)][seen]
        return np.concatenate([xy.min(axis=0), xy.max(axis=0)])

    def same_person(self, other: BodyPose) -> bool:
        """Whether two boxes of one image gave the joints of one person."""
        seen = np.minimum(self.confidence, other.confidence)[: len(BODY_15)] >= _SEEN
        if seen.sum() < 0.5 * len(seen):
            return False
        xy = other.xy[: len(BODY_15)][seen]
        apart = np.linalg.norm(self.xy[: len(BODY_15)][seen] - xy, axis=1)
        return bool(np.median(apart) < _SAME * np.ptp(xy, axis=0).max())
