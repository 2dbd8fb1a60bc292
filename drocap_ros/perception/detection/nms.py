"""Boxes that mean the same person."""

from __future__ import annotations

import numpy as np


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes x_min y_min x_max y_max; 0 for empty boxes."""
    common, areas, other_areas = _areas(boxes, others)
    union = areas[:, None] + other_areas[None] - common
    return np.divide(common, union, out=np.zeros_like(common), where=union > 0)


def shared(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over the smaller of two boxes; 0 for empty boxes."""
    common, areas, other_areas = _areas(boxes, others)
    smaller = np.minimum(areas[:, None], other_areas[None])
    return np.divide(common, smaller, out=np.zeros_like(common), where=smaller > 0)


def _areas(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersections (N, M) and areas (N,), (M,)."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    areas = np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1)
    return common, areas, np.prod(np.clip(others[:, 2:] - others[:, :2], 0, None), axis=1)


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


def whole(boxes: np.ndarray, scores: np.ndarray, inside: float = 0.8, smaller: float = 0.65) -> np.ndarray:
    """Indices of the boxes that are no part of a better one: legs or a trunk detected beside the whole person.

    boxes : (N, 4); scores : (N,)
    inside : share of a box within a better-scored one from which it may be a part of it
    smaller : share of the better one's area below which it is
    """
    areas = np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1)
    better = scores[None] > scores[:, None]
    part = better & (shared(boxes, boxes) > inside) & (areas[:, None] < smaller * areas[None])
    return np.nonzero(~part.any(axis=1))[0]
