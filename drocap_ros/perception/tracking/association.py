"""Assignment of detections to persons, gated by distance, size and appearance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.perception.detection.nms import areas_of, iou, overlap_coefficient
from drocap_ros.perception.tracking.identity import MIXED_IOU, known_other, replaced
from drocap_ros.perception.tracking.person import Person, boxes_of

_SIZE_WEIGHT = 0.4  # of the change of size against the distance, each over its gate
_APPEARANCE_WEIGHT = 5.0  # another person's appearance differs by 0.05 to 0.2, the own by 0.02
_SCORE_WEIGHT = 2.0  # a whole person scores higher than a part
_GAP_WEIGHT = 1.0  # per second without detection: of two persons near one detection the one just seen takes it
_REACH = 0.35  # lengths that a person may be from the prediction at once,
_REACH_PER_S = 2.0  # and more per second without detection
#: Largest distance, lengths, of others than the subject.  Nobody looks for them at their places, but who is near the
#: subject is rarely one of those from far away.
_OTHERS_REACH = 1.35
_SCOPE = 0.55  # logarithm of the size by which a person may change at once,
_SCOPE_PER_S = 0.6  # and more per second without detection
_SAME_PLACE = 0.6  # overlap with the last box from which a large change of size is possible: a person enters the image,
_ENTRANCE_GROWTH = 1.3  # and its largest logarithm
_LOW_SCORE_IOU = 0.35  # least overlap of a low-score detection with the prediction
_IMPOSSIBLE = 1e6  # cost of a pair outside the gates: more than any possible one


class Seen(NamedTuple):
    """Detections in one image: boxes (N, 4) px, scores (N,), and N descriptors of the appearance."""

    boxes: np.ndarray
    scores: np.ndarray
    appearances: list[np.ndarray | None]

    def at(self, indices: np.ndarray) -> Seen:
        """Those of the indices (M,)."""
        return Seen(self.boxes[indices], self.scores[indices], [self.appearances[j] for j in indices])

    def mixed(self, j: int) -> bool:
        """Whether detection ``j`` overlaps another one, so that its appearance is mixed."""
        overlap = iou(self.boxes[j][None], self.boxes)[0]
        overlap[j] = 0.0
        return bool((overlap > MIXED_IOU).any())


def assign_all(
    subject: Person | None, others: list[Person], seen: Seen, stamp_ns: int, threshold: float
) -> tuple[set[int], list[Person]]:
    """Update persons with their detections: first the reliable ones, then the others, then with low scores.

    subject : None while it is lost
    threshold : score below which a detection only continues a reliable track

    Returns
    -------
    Indices of the assigned detections, and new persons who stand at once in the subject's place.
    """
    persons = others if subject is None else [subject, *others]
    first = [p is subject or (p.reliable and not p.double) for p in persons]
    reliable = [p for p, is_first in zip(persons, first, strict=True) if is_first]
    unreliable = [p for p, is_first in zip(persons, first, strict=True) if not is_first]
    high = seen.scores >= threshold
    rounds = _Rounds(subject, others, seen, stamp_ns)
    rounds.assign(reliable, high)
    rounds.assign(unreliable, high)
    rounds.assign(reliable, ~high, low_score=True)
    return rounds.assigned, rounds.replacements


class _Rounds:
    """Assignment of one image's detections in several rounds."""

    def __init__(self, subject: Person | None, others: list[Person], seen: Seen, stamp_ns: int) -> None:
        self._subject, self._others, self._seen, self._stamp_ns = subject, others, seen, stamp_ns
        self.assigned: set[int] = set()
        self.replacements: list[Person] = []
        #: A detection of the subject was someone else's: a low-score one must not replace it either.
        self._refused = False

    def assign(self, owners: list[Person], group: np.ndarray, low_score: bool = False) -> None:
        """Update owners without detection from those of the group (N,) that are not yet assigned."""
        free = [p for p in owners if p.detected_ns < self._stamp_ns and not (self._refused and p is self._subject)]
        at = np.array([j for j in np.nonzero(group)[0] if j not in self.assigned], int)
        for i, k in assign(free, self._seen.at(at), self._stamp_ns, low_score, self._subject):
            self._update(free[i], int(at[k]), low_score)

    def _update(self, person: Person, j: int, low_score: bool) -> None:
        """Update a person with the detection ``j``, unless it shows someone else in the subject's place."""
        if person is self._subject and self._is_other(person, j):
            self._refused = True
            return
        self.assigned.add(j)
        person.update(self._seen.boxes[j], float(self._seen.scores[j]), self._stamp_ns)
        if not low_score:
            person.confirm(self._stamp_ns)
        if person.pose.believed and not self._seen.mixed(j):
            person.update_appearance(self._seen.appearances[j])

    def _is_other(self, subject: Person, j: int) -> bool:
        """Whether the subject's detection ``j`` is another person: a new track, or for a later round a known one."""
        box, score, appearance = self._seen.boxes[j], float(self._seen.scores[j]), self._seen.appearances[j]
        if not replaced(subject, box, appearance, self._stamp_ns):
            return known_other(subject, self._others, box, appearance)
        self.replacements.append(Person(box, score, self._stamp_ns, appearance))
        self.assigned.add(j)
        return True


def assign(
    persons: list[Person], seen: Seen, stamp_ns: int, low_score: bool = False, subject: Person | None = None
) -> list[tuple[int, int]]:
    """Pairs (person, detection) of least total cost within the gates of distance and size.

    persons : predicted to ``stamp_ns``
    low_score : require a high overlap with the prediction, for detections that may be clutter
    subject : the person among them for whom the detector looks in every image
    """
    if not persons or not len(seen.boxes):
        return []
    from scipy.optimize import linear_sum_assignment

    cost = _costs(persons, seen, stamp_ns, low_score, subject)
    rows, columns = linear_sum_assignment(cost)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if cost[i, j] < _IMPOSSIBLE]


def _costs(persons: list[Person], seen: Seen, stamp_ns: int, low_score: bool, subject: Person | None) -> np.ndarray:
    """(M, N) of the pairs of :func:`assign`."""
    boxes = seen.boxes
    predicted = np.array([p.filter.box() for p in persons])
    gap = np.array([p.undetected_s(stamp_ns) for p in persons])[:, None]
    # The box of a person who is half hidden is shorter than the person.
    usual = np.array([p.pose.length for p in persons])
    length = np.maximum((predicted[:, 2:] - predicted[:, :2]).max(axis=1), np.maximum(usual, 1.0))[:, None]
    centres, places = ((b[:, :2] + b[:, 2:]) / 2 for b in (boxes, predicted))
    distance = np.linalg.norm(places[:, None] - centres[None], axis=2) / length
    size, usual_size = (np.sqrt(np.maximum(areas_of(b), 1.0)) for b in (boxes, predicted))
    growth = np.abs(np.log(size[None] / usual_size[:, None]))
    farthest = np.array([np.inf if p is subject else _OTHERS_REACH for p in persons])[:, None]
    reach, scope = np.minimum(_REACH + _REACH_PER_S * gap, farthest), _SCOPE + _SCOPE_PER_S * gap
    overlap = np.maximum(overlap_coefficient(predicted, boxes), overlap_coefficient(boxes_of(persons), boxes))
    possible = (distance < reach) & (growth < scope) | (overlap > _SAME_PLACE) & (growth < _ENTRANCE_GROWTH)
    possible &= _allowed(persons, predicted, boxes, low_score, subject, overlap)
    difference = 1.0 - np.array([[p.similarity(appearance) for appearance in seen.appearances] for p in persons])
    cost: np.ndarray = (
        distance / reach
        + _SIZE_WEIGHT * growth / scope
        + _APPEARANCE_WEIGHT * difference
        + _SCORE_WEIGHT * (1.0 - seen.scores)
        + _GAP_WEIGHT * gap
    )
    return np.where(possible, cost, _IMPOSSIBLE)


def _allowed(
    persons: list[Person],
    predicted: np.ndarray,
    boxes: np.ndarray,
    low_score: bool,
    subject: Person | None,
    overlap: np.ndarray,
) -> np.ndarray:
    """(M, N) bool: pairs that are not forbidden whatever their distance."""
    # What is no person stays in its place: a person who comes out from behind it is a new track.
    strict = np.array([low_score or not p.plausible for p in persons])[:, None]
    allowed: np.ndarray = ~strict | (iou(predicted, boxes) > _LOW_SCORE_IOU)
    if subject is not None:  # a further box at the subject's place is its limb or shadow, nobody's from elsewhere
        further = overlap_coefficient(subject.filter.box()[None], boxes) > _SAME_PLACE
        elsewhere = np.array([p is not subject for p in persons])[:, None] & (overlap <= MIXED_IOU)
        allowed &= ~(further & elsewhere)
    return allowed
