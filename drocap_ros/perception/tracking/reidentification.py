"""Identity decisions: whether a detection or a new track is the subject or another person."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.tracking.person import Person, boxes_of
from drocap_ros.perception.tracking.pose_belief import SURE_CONFIDENCE

#: Overlap above which two persons' appearances mix.
MIXED_IOU = 0.1
#: Time after which a lost subject is not re-identified.
FORGET_S = 20.0
#: Similarity from which a detection is the subject's without comparison with others.
_OWN_SIMILARITY = 0.85
#: Least similarity by which another person's appearance has to fit better.
_SIMILARITY_MARGIN = 0.05
#: A detection below this similarity, within this time and at nearly this size, is another person: sun and shade change
#: the own similarity to 0.8; stooping and entering the image change it to 0.6, but the size with it.
_OTHER_SIMILARITY, _SUDDEN_S, _SAME_SIZE = 0.7, 0.15, 0.2
#: Mean score from which the subject's appearance is reliable.
_CLEAR_SCORE = 0.6
#: Least similarity of a new track with the lost subject.
_REIDENTIFY_SIMILARITY = 0.92
#: The same for the only person who may be the subject, within this time.
_ALONE_SIMILARITY, _ALONE_S = 0.85, 6.0
#: Time for which someone new is looked at before the subject is given up for them.
_KNOWN_S = 1.0
#: Time of a search over the whole image after which someone whom it does not find is out of view.
_GONE_S = 0.4
#: Overlap coefficient above which two boxes are one person's.
_DOUBLE = 0.75
#: Longest gap of a person that the search without a subject centres on.
_CANDIDATE_S = 0.3
#: Growth of the search around the last place, lengths per second, and its farthest reach, lengths.
_WIDER_PER_S, _WIDEST = 0.5, 2.0
#: Outward speed, lengths/s, of a box at the image's edge that counts as leaving.
_LEAVING_SPEED = 0.15


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
    """Whether a person may be the lost subject: not certainly in view together with it.

    Someone in view may be the subject if the track of the subject was no person's by then, or its own was none before.
    """
    since_ns = person.pose.plausible_ns
    return since_ns is not None and max(since_ns, person.first_ns) > lost.certain_ns and not person.pose.other


def same_person(lost: Person, person: Person, alone: bool) -> bool:
    """Whether a track fits the lost subject's appearance, and its distance and size the elapsed time.

    alone : no one else in view may be the subject; then a certain pose makes up for some change of the light
    """
    since_ns = max(person.first_ns, person.pose.plausible_ns or 0)
    gap = (since_ns - lost.certain_ns) * 1e-9
    if gap > FORGET_S:
        return False
    start, end = lost.box if lost.pose.box is None else lost.pose.box, person.box
    length = max(lost.filter.length, lost.pose.length, 1.0)
    distance = float(np.linalg.norm((start[:2] + start[2:] - end[:2] - end[2:]) / 2)) / length
    growth = lost.pose.growth(end, length)
    similarity = person.similarity(lost.appearance)
    if lost.left_image:  # re-entry at the place of leaving, at half the usual difference of appearance
        return distance < 1.5 and similarity >= 0.5 * (1 + _REIDENTIFY_SIMILARITY)
    least = _REIDENTIFY_SIMILARITY
    if alone and gap < _ALONE_S and person.pose.last >= SURE_CONFIDENCE:
        least = _ALONE_SIMILARITY
    return distance < 1.0 + 1.5 * gap and growth < 0.5 + 0.3 * gap and similarity >= least


def found_again(lost: Person, persons: list[Person], confirm_frames: int, stamp_ns: int) -> Person | None:
    """Whom of the persons detected in this image is the lost subject."""
    seen = [p for p in persons if p is not lost and p.detected_ns == stamp_ns and could_be(lost, p)]
    boxes = boxes_of(seen)
    for person in seen:
        early = person.hits < confirming_hits(person, confirm_frames)
        # A second box around the same person is no other one.
        alone = bool((overlap_coefficient(person.box[None], boxes) > _DOUBLE).all())
        if early or fits_other(lost, person, persons, stamp_ns):
            continue
        if same_person(lost, person, alone):
            return person
    return None


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


def confirming_hits(person: Person, confirm_frames: int) -> int:
    """Number of detections that confirm a track; a certain pose makes up for some."""
    return min(2, confirm_frames) if person.pose.last >= SURE_CONFIDENCE else confirm_frames


def search_boxes(lost: Person | None, persons: list[Person], confirm_frames: int, stamp_ns: int) -> list[np.ndarray]:
    """(4,) px each, where to look closely without a subject: a possible new one, and around the last place.

    A small person needs a window around it to be confirmed.
    """
    recent = [p for p in persons if p is not lost and p.plausible and p.undetected_s(stamp_ns) <= _CANDIDATE_S]
    if lost is not None:  # persons in view together with the subject cannot be the subject
        recent = [p for p in recent if could_be(lost, p)]
    boxes = []
    if recent:
        best = max(recent, key=lambda p: (p.hits < confirm_frames, p.mean_score))
        boxes.append(best.filter.box_at(stamp_ns))
    if lost is not None and not lost.left_image and lost.unconfirmed_s(stamp_ns) <= FORGET_S:
        reach = min(_WIDER_PER_S * lost.unconfirmed_s(stamp_ns), _WIDEST) * lost.filter.length
        boxes.append(lost.box + reach * np.array([-1, -1, 1, 1]))
    return boxes


def leaving(person: Person, image_shape: tuple[int, ...]) -> bool:
    """Whether the person's last box touches an edge of the image and moves outwards."""
    height, width = image_shape[:2]
    edge = 0.01 * max(width, height)
    x0, y0, x1, y1 = person.box
    vx, vy = person.filter.x[:2, 1] / person.filter.length
    out = ((x0 < edge, -vx), (x1 > width - edge, vx), (y0 < edge, -vy), (y1 > height - edge, vy))
    return any(at_edge and speed > _LEAVING_SPEED for at_edge, speed in out)
