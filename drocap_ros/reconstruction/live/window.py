"""A live window before and after its adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.live.effort import Effort


class Window(NamedTuple):
    """F frames of one subject.

    stamp_ns : (F,) increasing
    keypoints : of BODY_17, with confidence and covariance (NaN where unknown)
    initial_joints : (F, 17, 3) m, camera axes
    subject : differs for every subject and for every pass of time
    """

    stamp_ns: np.ndarray
    keypoints: Keypoints2D
    initial_joints: np.ndarray
    subject: int = 0

    def every(self, stride: int) -> Window:
        """Every ``stride``-th frame, counted back from the newest."""
        chosen = slice((len(self.stamp_ns) - 1) % stride, None, stride)
        return Window(self.stamp_ns[chosen], self.keypoints[chosen], self.initial_joints[chosen], self.subject)


@dataclass(frozen=True)
class AdjustedWindow:
    """Poses of a window: joints3d (F, 17, 3) m and covariance (F, 17, 6) m^2 in camera axes, pelvis at the origin.

    effort : repeats the adjustment bit for bit
    """

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: np.ndarray
    iterations: int
    cost: float
    stop_reason: str
    cost_terms: dict[str, float]
    effort: Effort = field(default_factory=Effort)
