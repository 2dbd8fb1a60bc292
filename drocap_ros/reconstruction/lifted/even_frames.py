"""Frames at any times on an even grid: the network and the adjustment count time in frames."""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.lifted.lifter_input import LIFTER_FPS


def even_slots(stamp_ns: np.ndarray) -> tuple[np.ndarray, float]:
    """Slot (F,) of each frame on an even grid of the median frame time, and the frames per second.

    A pause counts as at most a second, and the grid has at most four slots per frame.
    """
    if len(stamp_ns) < 2:
        return np.zeros(len(stamp_ns), np.intp), LIFTER_FPS
    step = np.diff(stamp_ns).astype(np.float64)
    usual = float(np.median(step))
    fps = float(np.clip(1e9 / usual, 1.0, 1000.0))
    places = np.clip(np.round(step / usual), 1, max(round(fps), 1)).astype(np.intp)
    if places.sum() > 4 * len(stamp_ns):
        places[:] = 1
    return np.concatenate([[0], np.cumsum(places)]), fps


def spread_keypoints(keypoints: Keypoints2D, slot: np.ndarray) -> Keypoints2D:
    """Keypoints at their slots of the even grid; empty slots have no seen joint."""
    confidence, covariance = keypoints.confidence, keypoints.covariance
    return Keypoints2D(
        spread(keypoints.xy, slot, np.nan),
        None if confidence is None else spread(confidence, slot, 0.0),
        None if covariance is None else spread(covariance, slot, np.nan),
    )


def spread(values: np.ndarray, slot: np.ndarray, empty: float) -> np.ndarray:
    """Values (F, ...) at their slots of the even grid, ``empty`` between them."""
    out = np.full((slot[-1] + 1, *values.shape[1:]), empty)
    out[slot] = values
    return out
