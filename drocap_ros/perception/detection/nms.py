"""Boxes that mean the same person."""

from __future__ import annotations

import numpy as np


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes x_min y_min x_max y_max; 0 for empty boxes."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    areas = np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1)
    other_areas = np.prod(np.clip(others[:, 2:] - others[:, :2], 0, None), axis=1)
    union = areas[:, None] + other_areas[None] - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def suppress(boxes: np.ndarray, scores: np.ndarray, threshold: float, limit: int = 100) -> np.ndarray:
    """Indices of the boxes kept, by falling score: greedy non-maximum suppression.

    boxes : (N, 4); scores : (N,); threshold : overlap above which the weaker box goes; limit : most boxes kept
    """
    order = np.argsort(-scores, kind="stable")[: 10 * limit]
    overlap = iou(boxes[order], boxes[order])
    kept: list[int] = []
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if alive[i]:
            kept.append(i)
            if len(kept) == limit:
                break
            alive &= overlap[i] <= threshold
    return order[kept]
