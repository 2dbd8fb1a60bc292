"""Observations of a synthetic walk, as the live nodes receive them."""

from __future__ import annotations

import numpy as np
from walking import make_walk, stamps

from drocap_ros.keypoints import PoseObservation


def observed(
    frames: int,
    begin_ns: int = 0,
    track_id: int = 1,
    size: float = 1.0,
    covariance_px2: float = np.nan,
    keypoints: np.ndarray | None = None,
) -> list[PoseObservation]:
    """One observation per image at 24 Hz; ``size`` scales the person in the image."""
    keypoints = make_walk(frames).keypoints if keypoints is None else keypoints
    covariance = np.tile(np.array([covariance_px2, 0.0 * covariance_px2, covariance_px2], np.float32), (15, 1))
    return [
        PoseObservation(
            begin_ns + int(stamp),
            track_id,
            (1280, 1024),
            keypoints=points,
            covariance=covariance,
            confidence=np.ones(15, np.float32),
        )
        for stamp, points in zip(stamps(frames), keypoints.astype(np.float32) * size, strict=True)
    ]
