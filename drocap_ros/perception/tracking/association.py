"""Who is whom: detections to persons by distance, size and appearance, and the lost subject found again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.perception.detection.nms import areas_of, iou, overlap_coefficient
from drocap_ros.perception.tracking.person import SURE_CONFIDENCE, Person, boxes_of

MIXED_IOU = 0.1  # overlap above which two persons' appearances mix
FORGET_S = 20.0  # time after which a lost subject is not re-identified
_OWN_SIMILARITY = 0.85  # from which a detection is the subject's without comparison with others
_SIMILARITY_MARGIN = 0.05  # by which another person's appearance has to fit better
#: A detection below this similarity, at once and at nearly the same size, is another person: sun and shade change the
#: own similarity to 0.8; stooping and entering the image change it to 0.6, but the size with it.
_OTHER_SIMILARITY = 0.7
_SUDDEN_S = 0.15  # longest gap that counts as at once
_SAME_SIZE = 0.2  # largest logarithm of the ratio of nearly the same sizes
_CLEAR_SCORE = 0.6  # mean score from which the subject's appearance is reliable
_REIDENTIFY_SIMILARITY = 0.92  # least similarity of a new track with the lost subject: others have 0.8 to 0.95
_ALONE_SIMILARITY = 0.85  # the same for the only person who may be the subject: the light may change,
_ALONE_S = 6.0  # within this time
_KNOWN_S = 1.0  # time for which someone new is looked at before the subject is given up for them
_AWAY = 1.0  # lengths from the last certain place at which a lost subject may come into view at once,
_AWAY_PER_S = 1.5  # and more per second: a run
_GONE_S = 0.4  # of a search over the whole image after which someone whom it does not find is out of view
_ONE_PERSON = 0.75  # overlap coefficient above which two boxes are one person's,
_APART = 0.5  # and below which they hold two persons, if each holds one
_SECOND_IOU = 0.35  # overlap from which a new track beside the detected subject is a second box of it,
_SECOND_SIMILARITY = 0.93  # if it looks like it


def replaced(subject: Person, box: np.ndarray, appearance: np.ndarray | None, stamp_ns: int) -> bool:
    """Whether the box (4,) px shows another person of the same size at once in the subject's place."""
    if appearance is None or not subject.appearance_settled or subject.undetected_s(stamp_ns) > _SUDDEN_S:
        return False
    if subject.mean_score < _CLEAR_SCORE:
        return False
    growth = np.abs(np.log(np.maximum(box[2:] - box[:2], 1.0) / np.maximum(subject.box[2:] - subject.box[:2], 1.0)))
    return bool(growth.max() < _SAME_SIZE) and subject.similarity(appearance) < _OTHER_SIMILARITY


def known_other(subject: Person, persons: list[Person], box: np.ndarray, appearance: np.ndarray | None) -> bool:
    """Whether a detection near the subject fits the appearance of a tracked bystander there better."""
    if appearance is None:
        return False
    own = subject.similarity(appearance)
    if own >= _OWN_SIMILARITY:
        return False
    others = [p for p in persons if p is not subject and p.reliable]
    predicted = np.array([p.filter.box() for p in others]).reshape(-1, 4)
    near = iou(box[None].astype(float), predicted)[0] > MIXED_IOU
    return any(p.similarity(appearance) > own + _SIMILARITY_MARGIN for p, at in zip(others, near, strict=True) if at)


def could_be(lost: Person, person: Person) -> bool:
    """Whether a person may be the lost subject: not certainly in view together with it, and begun within its reach.

    Someone in view may be the subject if the track of the subject was no person's by then, or its own was none before.
    """
    since_ns = person.pose.plausible_ns
    if since_ns is None or person in lost.others or since_ns <= lost.certain_ns:
        return False
    start = lost.box if lost.pose.box is None else lost.pose.box
    distance = float(np.linalg.norm((start[:2] + start[2:] - person.pose.began[:2] - person.pose.began[2:]) / 2))
    return distance < (_AWAY + _AWAY_PER_S * (since_ns - lost.certain_ns) * 1e-9) * lost.usual_length


def same_person(lost: Person, person: Person, alone: bool) -> bool:
    """Whether a track that may be the lost subject fits its appearance, and its size the elapsed time.

    alone : no one else in view may as well be the subject; then a certain pose makes up for some change of the light
    """
    gap = ((person.pose.plausible_ns or 0) - lost.certain_ns) * 1e-9
    if gap > FORGET_S:
        return False
    similarity = person.similarity(lost.appearance)
    certain = alone and gap < _ALONE_S and person.pose.last >= SURE_CONFIDENCE
    if similarity < (_ALONE_SIMILARITY if certain else _REIDENTIFY_SIMILARITY):
        return False
    return lost.pose.growth(person.box, lost.usual_length) < 0.5 + 0.3 * gap


def found_again(lost: Person, persons: list[Person], confirm_frames: int, stamp_ns: int) -> Person | None:
    """Whom of the persons detected in this image is the lost subject."""
    seen = [p for p in persons if p is not lost and p.detected_ns == stamp_ns and could_be(lost, p)]
    for person in seen:
        hits = min(2, confirm_frames) if person.pose.last >= SURE_CONFIDENCE else confirm_frames
        if person.hits < hits or fits_other(lost, person, persons, stamp_ns):
            continue
        if same_person(lost, person, _alone(lost, person, seen)):
            return person
    return None


def _alone(lost: Person, person: Person, persons: list[Person]) -> bool:
    """Whether no one else of the persons, one of whom is the person, may as well be the lost subject."""
    # A second box around the same person is no other one, and someone who looks clearly different is none.
    looks = np.array([p.similarity(lost.appearance) for p in persons])
    same = overlap_coefficient(person.box[None], boxes_of(persons))[0] > _ONE_PERSON
    return bool((same | (looks < person.similarity(lost.appearance) - _SIMILARITY_MARGIN)).all())


def followed_on(lost: Person | None, persons: list[Person], coast_s: float, stamp_ns: int) -> list[Person]:
    """Persons without the subject whose tracks take further detections.

    Of those whom a search over the whole image did not find, one may come out of cover, or the lost subject in their
    place: that is a new track.
    """
    others = [p for p in persons if p is not lost]
    if lost is None or lost.unconfirmed_s(stamp_ns) <= coast_s + _GONE_S:
        return others
    return [p for p in others if p.undetected_s(stamp_ns) <= _GONE_S]


def fits_other(lost: Person, person: Person, persons: list[Person], stamp_ns: int) -> bool:
    """Whether a new track clearly looks more like someone else who went out of view."""
    gone = [p for p in persons if p is not lost and p.plausible and p.undetected_s(stamp_ns) > _GONE_S]
    own = person.similarity(lost.appearance)
    return any(person.similarity(p.appearance) > own + _SIMILARITY_MARGIN for p in gone if p.appearance is not None)


def certainly_others(lost: Person, persons: list[Person], stamp_ns: int) -> list[Person]:
    """Persons without those who have just come into view: half hidden as yet, they may be the lost subject."""
    return [p for p in persons if (stamp_ns - p.first_ns) * 1e-9 >= _KNOWN_S or not could_be(lost, p)]


# Second boxes around the subject: a detector that doubts the extent of a person gives two of it.  As a bystander the
# second one would take the next detections from the subject and hide it; and a person in view together with the
# subject is never the subject again.


def _apart(person: Person, subject: Person) -> bool:
    return bool(overlap_coefficient(person.box[None], subject.box[None])[0, 0] < _APART)


def compare_new(person: Person, subject: Person | None, appearance: np.ndarray | None) -> None:
    """Mark a new track that began at the place of the subject, detected in the same image, and looks like it."""
    if subject is None or subject.detected_ns != person.detected_ns:
        return
    person.began_at_subject = not _apart(person, subject)
    overlap = float(iou(person.box[None], subject.box[None])[0, 0])
    person.double = (
        appearance is not None and overlap > _SECOND_IOU and subject.similarity(appearance) > _SECOND_SIMILARITY
    )


def compare_joints(person: Person, subject: Person, same: bool) -> None:
    """Mark a certain person by its joints, seen in the same image as the certain subject's.

    same : whether they are the subject's.  Whoever came from elsewhere is someone else all the same: a pose found
        behind the subject is the subject's
    """
    # Of two boxes in each other one may hold the person and its shadow.
    if _apart(person, subject):
        subject.others.add(person)
    person.double |= same and person.began_at_subject


def compare_places(persons: list[Person], subject: Person | None, stamp_ns: int) -> None:
    """Unmark those who came out from behind the subject: both were detected, apart from each other."""
    if subject is None or subject.detected_ns != stamp_ns:
        return
    for person in persons:
        if person.began_at_subject and person.detected_ns == stamp_ns and _apart(person, subject):
            person.began_at_subject = person.double = False


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
