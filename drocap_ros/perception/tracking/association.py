"""Assignment of detections to persons, gated by distance, size and appearance."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.reidentification import MIXED_IOU, known_other, replaced

_IMPOSSIBLE = 1e6
#: Weights of size, appearance and score against the distance: another person's appearance differs by 0.05 to 0.2, the
#: own by 0.02; a whole person scores higher than a part.
_SIZE_WEIGHT, _APPEARANCE_WEIGHT, _SCORE_WEIGHT = 0.4, 5.0, 2.0
#: Distance from the prediction that a person may have, lengths: at once, more per second without detection, and the
#: largest one of others than the subject.  Nobody looks for them at their places, but who is near the subject is rarely
#: one of those from far away.
_REACH, _REACH_PER_S, _OTHERS_REACH = 0.35, 2.0, 1.35
#: Cost per second without detection: of two persons near one detection the one who was just seen takes it.
_GAP_WEIGHT = 1.0
#: Overlap with the last box from which a large change of size is possible: a person enters the image.
_SAME_PLACE, _ENTRANCE_GROWTH = 0.6, 1.3
#: Least overlap of a low-score detection with the prediction.
_LOW_SCORE_IOU = 0.35


def assign_all(
    subject: Person | None,
    others: list[Person],
    boxes: np.ndarray,
    scores: np.ndarray,
    appearances: list[np.ndarray | None],
    stamp_ns: int,
    threshold: float,
) -> tuple[set[int], list[Person]]:
    """Update persons with their detections: first the reliable ones, then the others, then with low scores.

    Parameters
    ----------
    subject : None while it is lost
    boxes : (N, 4) px; scores : (N,); appearances : N descriptors
    threshold : score below which a detection only continues a reliable track

    Returns
    -------
    Indices of the assigned detections, and new persons who stand at once in the subject's place.
    """
    persons = others if subject is None else [subject, *others]
    reliable = [p for p in persons if p is subject or (p.reliable and not p.double)]
    unreliable = [p for p in persons if not any(p is q for q in reliable)]
    high = scores >= threshold
    assigned: set[int] = set()
    refused: set[int] = set()
    replacements: list[Person] = []
    for owners, group in ((reliable, high), (unreliable, high), (reliable, ~high)):
        free = [p for p in owners if p.detected_ns < stamp_ns and id(p) not in refused]
        at = np.array([j for j in np.nonzero(group)[0] if j not in assigned], int)
        found = boxes[at], scores[at], [appearances[j] for j in at]
        pairs = assign(free, *found, stamp_ns, group is not high, subject)
        for i, k in pairs:
            person, j = free[i], int(at[k])
            if person is subject:
                if replaced(subject, boxes[j], appearances[j], stamp_ns):
                    replacements.append(Person(boxes[j], float(scores[j]), stamp_ns, appearances[j]))
                    refused.add(id(person))
                    assigned.add(j)
                    continue
                if known_other(subject, others, boxes[j], appearances[j]):
                    refused.add(id(person))  # a low-score detection must not replace it either
                    continue
            person.update(boxes[j], float(scores[j]), stamp_ns)
            if group is high:
                person.confirm(stamp_ns)
            if person.pose.believed and not _mixed(boxes, j):
                person.update_appearance(appearances[j])
            assigned.add(j)
    return assigned, replacements


def _mixed(boxes: np.ndarray, j: int) -> bool:
    """Whether detection ``j`` overlaps another one, so that its appearance is mixed."""
    overlap = iou(boxes[j][None], boxes)[0]
    overlap[j] = 0.0
    return bool((overlap > MIXED_IOU).any())


def assign(
    persons: list[Person],
    boxes: np.ndarray,
    scores: np.ndarray,
    appearances: list[np.ndarray | None],
    stamp_ns: int,
    low_score: bool = False,
    subject: Person | None = None,
) -> list[tuple[int, int]]:
    """Pairs (person, detection) of least total cost within the gates of distance and size.

    Parameters
    ----------
    persons : predicted to ``stamp_ns``
    boxes : (N, 4) px
    scores : (N,)
    appearances : N descriptors
    low_score : require a high overlap with the prediction, for detections that may be clutter
    subject : the person among them for whom the detector looks in every image
    """
    if not persons or not len(boxes):
        return []
    from scipy.optimize import linear_sum_assignment

    predicted = np.array([p.filter.box() for p in persons])
    gap = np.array([p.undetected_s(stamp_ns) for p in persons])[:, None]
    # The box of a person who is half hidden is shorter than the person.
    usual = np.array([p.pose.length for p in persons])
    length = np.maximum((predicted[:, 2:] - predicted[:, :2]).max(axis=1), np.maximum(usual, 1.0))[:, None]
    offset = _centres(predicted)[:, None] - _centres(boxes)[None]
    distance = np.linalg.norm(offset, axis=2) / length
    growth = np.abs(np.log(_sizes(boxes)[None] / _sizes(predicted)[:, None]))
    overlap = np.maximum(
        overlap_coefficient(predicted, boxes), overlap_coefficient(np.array([p.box for p in persons]), boxes)
    )
    farthest = np.array([np.inf if p is subject else _OTHERS_REACH for p in persons])[:, None]
    reach, scope = np.minimum(_REACH + _REACH_PER_S * gap, farthest), 0.55 + 0.6 * gap
    possible = (distance < reach) & (growth < scope) | (overlap > _SAME_PLACE) & (growth < _ENTRANCE_GROWTH)
    # What is no person stays in its place: a person who comes out from behind it is a new track.
    strict = np.array([low_score or not p.plausible for p in persons])[:, None]
    possible &= ~strict | (iou(predicted, boxes) > _LOW_SCORE_IOU)
    if subject is not None:  # a further box at the subject's place is its limb or shadow, nobody's from elsewhere
        further = overlap_coefficient(subject.filter.box()[None], boxes) > _SAME_PLACE
        elsewhere = np.array([p is not subject for p in persons])[:, None] & (overlap <= MIXED_IOU)
        possible &= ~(further & elsewhere)
    cost = np.full(possible.shape, _IMPOSSIBLE)
    for i, j in zip(*np.nonzero(possible), strict=True):
        difference = 1.0 - persons[i].similarity(appearances[j])
        cost[i, j] = (
            distance[i, j] / reach[i, 0]
            + _SIZE_WEIGHT * growth[i, j] / scope[i, 0]
            + _APPEARANCE_WEIGHT * difference
            + _SCORE_WEIGHT * (1.0 - scores[j])
            + _GAP_WEIGHT * gap[i, 0]
        )
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _IMPOSSIBLE]


def _centres(boxes: np.ndarray) -> np.ndarray:
    return (boxes[:, :2] + boxes[:, 2:]) / 2


def _sizes(boxes: np.ndarray) -> np.ndarray:
    """Square root of the area, at least 1 px."""
    return np.sqrt(np.maximum(np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1), 1.0))
