"""Overlap of boxes, and suppression of boxes of the same person."""

from __future__ import annotations

import numpy as np

#: Overlaps, of the union or of the smaller box: looks mix; one may hide the other, or be its box again; they are one.
TOUCHES, PARTLY, MOSTLY = 0.1, 0.3, 0.5
#: Most boxes that :func:`suppress` keeps: more persons than a tracker follows.
_MAX_BOXES = 100


def iou(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over union of (N, 4) and (M, 4) boxes x_min y_min x_max y_max; 0 for empty boxes."""
    common, areas, other_areas = _areas(boxes, others)
    union = areas[:, None] + other_areas[None] - common
    return np.asarray(np.divide(common, union, out=np.zeros_like(common), where=union > 0))


def overlap_coefficient(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N, M) intersection over the smaller of two boxes; 0 for empty boxes."""
    common, areas, other_areas = _areas(boxes, others)
    smaller = np.minimum(areas[:, None], other_areas[None])
    return np.asarray(np.divide(common, smaller, out=np.zeros_like(common), where=smaller > 0))


def areas_of(boxes: np.ndarray) -> np.ndarray:
    """(N,) areas of (N, 4) boxes, 0 for empty ones."""
    return np.asarray(np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1))


def _areas(boxes: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersections (N, M) and areas (N,), (M,)."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    return common, areas_of(boxes), areas_of(others)


def suppress(boxes: np.ndarray, scores: np.ndarray, max_iou: float = 0.6) -> np.ndarray:
    """Greedy non-maximum suppression: indices of the boxes kept, by falling score.

    boxes : (N, 4); scores : (N,); max_iou : overlap above which the weaker box is dropped
    """
    order = np.argsort(-scores, kind="stable")[: 10 * _MAX_BOXES]
    overlap = iou(boxes[order], boxes[order])
    kept: list[int] = []
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if alive[i]:
            kept.append(i)
            if len(kept) == _MAX_BOXES:
                break
            alive &= overlap[i] <= max_iou
    return order[kept]
