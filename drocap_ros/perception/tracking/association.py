"""Who is whom: one cost of a detection as a person's, in which each cue counts by its spread; nobody costs, too.

The cost is a negative log likelihood over that of a detection where it was expected.  Detections and persons are
assigned one to one, at the least sum: in a crossing each detection has its owner, and what fits no one is nobody's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import TOUCHES, iou, overlap_coefficient
from drocap_ros.perception.tracking.person import PREDICTION_S, QUESTION_S, SURE_CONFIDENCE, Person

ONE_PERSON = 0.75  # overlap coefficient above which two boxes may be one person's
FORGET_S = 20.0  # time after which a lost subject is not re-identified
#: Dissimilarity (1 - Bhattacharyya coefficient) by which the cost of a look grows by one: one person's looks differ by
#: 0.02 to 0.05 from image to image, two persons' in like clothes by 0.05 to 0.2;
_LOOK = 0.03
_MOST_LOOK = 14.0  # and its largest cost: sun, shade and stooping change one's own by 0.2 to 0.4
_OTHER_SIMILARITY = 0.7  # below which a look is someone else's
_STUDENT = 3.0  # degrees of freedom of an edge's error: cover, shadows and other persons take an edge away at a time
_AGAIN = 4.0  # cost of a detection that is mostly inside a better-scored one, or holds it: it may be that one again
_MISSED = 11.0  # cost of a person without detection: two edges off, or the look of someone else


def mixed(seen: Detections) -> np.ndarray:
    """(N,) bool, detections that overlap another one, so that their appearances are mixed."""
    overlap = iou(seen.boxes, seen.boxes)
    np.fill_diagonal(overlap, 0.0)
    return np.asarray((overlap > TOUCHES).any(axis=1))


def _again(seen: Detections) -> np.ndarray:
    """(N,) bool, detections that share most with one of a higher score."""
    better = seen.scores[None] > seen.scores[:, None]
    return np.asarray((better & (overlap_coefficient(seen.boxes, seen.boxes) > ONE_PERSON)).any(axis=1))


def look_cost(person: Person, appearances: Sequence[np.ndarray | None]) -> np.ndarray:
    """(N,) cost of descriptors as the person's."""
    unlike = 1.0 - np.array([person.similarity(appearance) for appearance in appearances])
    known = np.array([appearance is not None and person.appearance is not None for appearance in appearances], bool)
    return np.where(known, np.minimum(unlike / _LOOK, _MOST_LOOK), 1.0)


def is_someone_else(person: Person, appearance: np.ndarray | None) -> bool:
    """Whether a descriptor is not the person's, of whom enough is known."""
    known = appearance is not None and person.appearance_settled
    return known and person.similarity(appearance) < _OTHER_SIMILARITY


def place_cost(person: Person, boxes: np.ndarray, expected: bool = False) -> np.ndarray:
    """(N,) cost of the places of boxes (N, 4) px as the person's, who is predicted to their image.

    expected : of where the person was expected, before the last update
    """
    where = person.filter.expected if expected else person.filter
    deviation, weight, spread = where.edges(boxes, person.usual_length, person.moves)
    return np.asarray(0.5 * (_STUDENT + 1) * np.log1p(deviation**2 / _STUDENT) @ weight + np.log(spread))


def cost_of(persons: Sequence[Person], seen: Detections) -> np.ndarray:
    """(M, N) of the detections as the persons', who are predicted to their image."""
    cost = np.empty((len(persons), len(seen.boxes)))
    for i, person in enumerate(persons):
        cost[i] = place_cost(person, seen.boxes) + look_cost(person, seen.appearances) - np.log(seen.scores)
    return np.asarray(cost + _AGAIN * _again(seen))


def assign(persons: Sequence[Person], seen: Detections) -> list[tuple[int, int]]:
    """Pairs (person, detection) of the least sum of costs; whoever is in none was not detected."""
    if not persons or not len(seen.boxes):
        return []
    from scipy.optimize import linear_sum_assignment

    cost = cost_of(persons, seen)
    nobody = np.full((len(persons), len(persons)), np.inf)
    # Whoever is seen in most images is seen in this one; a box that came up once or twice rarely is.
    np.fill_diagonal(nobody, [_MISSED + np.log(p.rate / (1.0 - p.rate)) for p in persons])
    rows, columns = linear_sum_assignment(np.concatenate([cost, nobody], axis=1))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if j < len(seen.boxes)]


_LASTING_LOOK = 0.02  # as _LOOK between the means of many images: others have 0.05 to 0.2
_AWAY = np.array(
    [0.4, 0.2]
)  # deviation of the place (lengths) and logarithm of the size of a person not seen for long,
_AWAY_PER_S = np.array([0.4, 0.12])  # and more per second: a run is 1.5 lengths/s
_STRANGER = 6.0  # cost of a new track as nobody's who was seen before,
_ALONE = 9.0  # and where it is certainly a person and no one else may as well be the lost one: the light may change,
_ALONE_S = 6.0  # within this time
MARGIN = 1.5  # by which a cost has to be less than another's to be clearly less


def again_cost(lost: Person, person: Person) -> float:
    """Cost of a new track as a lost person's; infinite for who was in view beside it.

    Without poses everybody was who was there before.  With them a track that began on the person may be the person's
    own, and a shadow's may have become the person's.
    """
    since_ns = person.pose.plausible_ns
    if since_ns is None or person in lost.others:
        return np.inf
    gap = (since_ns - lost.certain_ns) * 1e-9
    if gap > FORGET_S or (gap <= 0 and person.pose.believed_ns is None):
        return np.inf
    gap = max(gap, 0.0)
    start = lost.box if lost.pose.box is None else lost.pose.box
    way = np.linalg.norm((start[:2] + start[2:] - person.pose.began[:2] - person.pose.began[2:]) / 2)
    off = np.array([way / lost.usual_length, lost.pose.growth(person.box, lost.usual_length)])
    unlike = 1.0 - lost.similarity(person.appearance)
    return float(0.5 * ((off / (_AWAY + _AWAY_PER_S * gap)) ** 2).sum() + unlike / _LASTING_LOOK)


def could_be(lost: Person, person: Person) -> bool:
    """Whether a person may be the lost one by place and time, whatever the look."""
    unlike = 1.0 - lost.similarity(person.appearance)
    return again_cost(lost, person) - unlike / _LASTING_LOOK < _STRANGER


def found_again(lost: Person, persons: list[Person], confirm_frames: int, stamp_ns: int) -> Person | None:
    """Whom of the persons detected in this image is the lost one: the likeliest, unless someone else is as likely."""
    costs = {p: again_cost(lost, p) for p in persons if p is not lost and p.detected_ns == stamp_ns}
    person = min(costs, key=costs.__getitem__, default=None)
    if person is None:
        return None
    sure = person.pose.last >= SURE_CONFIDENCE
    if person.hits < (min(2, confirm_frames) if sure else confirm_frames):
        return None
    # A box that came up once or twice, as a second one around the lost person, is nobody who comes back.
    known = [p for p in persons if p is not lost and p.plausible and p.hits > confirm_frames]
    gone = [p for p in known if p.undetected_s(stamp_ns) > PREDICTION_S]
    if any(look_cost(p, [person.appearance])[0] + MARGIN < look_cost(lost, [person.appearance])[0] for p in gone):
        return None
    # A second box around the same person is no other one.
    rivals = [p for p in costs if overlap_coefficient(person.box[None], p.box[None])[0, 0] <= ONE_PERSON]
    alone = all(costs[p] > costs[person] + MARGIN for p in rivals)
    gap = ((person.pose.plausible_ns or 0) - lost.certain_ns) * 1e-9
    return person if alone and costs[person] < (_ALONE if sure and gap < _ALONE_S else _STRANGER) else None


def followed_on(lost: Person | None, persons: list[Person], coast_s: float, stamp_ns: int) -> list[Person]:
    """Persons without the subject whose tracks take further detections.

    Of those whom a search over the whole image did not find, one may come out of cover, or the lost subject in their
    place: that is a new track.
    """
    others = [p for p in persons if p is not lost]
    if lost is None or lost.unconfirmed_s(stamp_ns) <= coast_s + PREDICTION_S:
        return others
    return [p for p in others if p.undetected_s(stamp_ns) <= PREDICTION_S]


def certainly_others(lost: Person, persons: list[Person], stamp_ns: int) -> list[Person]:
    """Persons without those who have just come into view: half hidden as yet, they may be the lost subject."""
    return [p for p in persons if (stamp_ns - p.first_ns) * 1e-9 >= QUESTION_S or not could_be(lost, p)]
