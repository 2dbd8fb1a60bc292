"""Covariance and confidence of keypoints, calibrated on labelled pictures."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.pose.keypoints import Keypoints


def calibrate(keypoints: Keypoints, layout: str) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) px^2 covariance and (P,) confidence in [0, 1]."""
    floor = (0.012 * keypoints.box_size) ** 2
    covariance = keypoints.spread.astype(float) + floor * np.array([1.0, 0.0, 1.0])
    return covariance, np.clip(keypoints.score.astype(float), 0, 1)
