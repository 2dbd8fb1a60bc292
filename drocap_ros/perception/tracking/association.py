"""Which detection is which person: a gated assignment on motion, size and look."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.tracking.person import Person

_NEVER = 1e6


def assign(
    persons: list[Person], boxes: np.ndarray, looks: list[np.ndarray | None], stamp_ns: int
) -> list[tuple[int, int]]:
    """Pairs (person, detection) of least total cost among those that motion and size allow.

    Parameters
    ----------
    persons : predicted to ``stamp_ns``
    boxes : (N, 4) px
    looks : N descriptions
    """
    if not persons or not len(boxes):
        return []
    from scipy.optimize import linear_sum_assignment

    cost = np.full((len(persons), len(boxes)), _NEVER)
    centres, heights = (boxes[:, :2] + boxes[:, 2:]) / 2, np.maximum(boxes[:, 3] - boxes[:, 1], 1.0)
    widths = np.maximum(boxes[:, 2] - boxes[:, 0], 1.0)
    for i, person in enumerate(persons):
        gap = person.gap_s(stamp_ns)
        predicted = person.motion.box()
        size = person.motion.height
        distance = np.linalg.norm(centres - (predicted[:2] + predicted[2:]) / 2, axis=1) / size
        growth = np.abs(np.log(np.sqrt(heights * widths) / np.sqrt(size * max(predicted[2] - predicted[0], 1.0))))
        reach, scope = 0.35 + 2.0 * gap, 0.45 + 0.6 * gap
        for j in np.nonzero((distance < reach) & (growth < scope))[0]:
            cost[i, j] = distance[j] / reach + 0.4 * growth[j] / scope + 2.0 * (1.0 - person.likeness(looks[j]))
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _NEVER]
