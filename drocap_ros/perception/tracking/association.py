"""Which detection is which person: a gated assignment on motion, size and look."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, shared
from drocap_ros.perception.tracking.person import Person

_NEVER = 1e6
#: Weights of size, look and score against the distance: another person's look differs by 0.05 to 0.2, one's own
#: by 0.02; of a whole person and a part, the whole scores higher.
_SIZE_WEIGHT, _LOOK_WEIGHT, _SCORE_WEIGHT = 0.4, 5.0, 2.0
#: A box that shares so much of the smaller one's area with the last may also change its size a lot: somebody
#: comes into the picture.
_SAME_PLACE, _ENTRANCE_GROWTH = 0.6, 1.3
#: Least overlap of a doubtful detection with the prediction.
_TIGHT_IOU = 0.35


def assign(
    persons: list[Person],
    boxes: np.ndarray,
    scores: np.ndarray,
    looks: list[np.ndarray | None],
    stamp_ns: int,
    tight: bool = False,
) -> list[tuple[int, int]]:
    """Pairs (person, detection) of least total cost among those that motion and size allow.

    Parameters
    ----------
    persons : predicted to ``stamp_ns``
    boxes : (N, 4) px
    scores : (N,)
    looks : N descriptions
    tight : allow only boxes that overlap the prediction well, for detections that may be clutter
    """
    if not persons or not len(boxes):
        return []
    from scipy.optimize import linear_sum_assignment

    predicted = np.array([p.motion.box() for p in persons])
    gap = np.array([p.gap_s(stamp_ns) for p in persons])[:, None]
    length = np.maximum((predicted[:, 2:] - predicted[:, :2]).max(axis=1), 1.0)[:, None]
    offset = _centres(predicted)[:, None] - _centres(boxes)[None]
    distance = np.linalg.norm(offset, axis=2) / length
    growth = np.abs(np.log(_sizes(boxes)[None] / _sizes(predicted)[:, None]))
    overlap = np.maximum(shared(predicted, boxes), shared(np.array([p.box for p in persons]), boxes))
    reach, scope = 0.35 + 2.0 * gap, 0.55 + 0.6 * gap
    possible = (distance < reach) & (growth < scope) | (overlap > _SAME_PLACE) & (growth < _ENTRANCE_GROWTH)
    if tight:
        possible &= iou(predicted, boxes) > _TIGHT_IOU
    cost = np.full(possible.shape, _NEVER)
    for i, j in zip(*np.nonzero(possible), strict=True):
        unlike = 1.0 - persons[i].likeness(looks[j])
        cost[i, j] = (
            distance[i, j] / reach[i, 0]
            + _SIZE_WEIGHT * growth[i, j] / scope[i, 0]
            + _LOOK_WEIGHT * unlike
            + _SCORE_WEIGHT * (1.0 - scores[j])
        )
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _NEVER]


def _centres(boxes: np.ndarray) -> np.ndarray:
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _sizes(boxes: np.ndarray) -> np.ndarray:
    """Square root of the area, at least 1 px."""
    return np.sqrt(np.maximum(np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1), 1.0))
