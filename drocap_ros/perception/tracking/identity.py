"""Identity decisions: whether a detection or a track is the subject, a second box of it, or another person."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
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
_REACH = 1.0  # lengths from the last certain place at which a lost subject may come into view at once,
_REACH_PER_S = 1.5  # and more per second: a run
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
    return distance < (_REACH + _REACH_PER_S * (since_ns - lost.certain_ns) * 1e-9) * lost.usual_length


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
