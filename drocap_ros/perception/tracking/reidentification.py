"""Identity decisions: whether a detection or a new track is the subject or another person."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.tracking.person import Person

#: Least mean score of a bystander in comparisons with the subject; body parts and clutter score below.
RELIABLE_SCORE = 0.4
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
#: Overlap and similarity from which a new track beside the detected subject is a second box around the same person.
_DOUBLE_IOU, _DOUBLE_SIMILARITY = 0.35, 0.93
#: Least similarity of a new track with the lost subject.
_REIDENTIFY_SIMILARITY = 0.92
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


def is_double(subject: Person, box: np.ndarray, appearance: np.ndarray | None, stamp_ns: int) -> bool:
    """Whether a detection (4,) px without owner is a second box around the subject, detected in the same image.

    A detector that doubts the extent of a person gives two boxes of it.  As a bystander the second one would take the
    next detections from the subject and hide it.
    """
    if appearance is None or subject.detected_ns != stamp_ns:
        return False
    overlap = float(iou(box[None].astype(float), subject.box[None])[0, 0])
    return overlap > _DOUBLE_IOU and subject.similarity(appearance) > _DOUBLE_SIMILARITY


def known_other(subject: Person, persons: list[Person], box: np.ndarray, appearance: np.ndarray | None) -> bool:
    """Whether a detection near the subject fits the appearance of a tracked bystander there better."""
    if appearance is None:
        return False
    own = subject.similarity(appearance)
    if own >= _OWN_SIMILARITY:
        return False
    others = [p for p in persons if p is not subject and p.mean_score >= RELIABLE_SCORE]
    predicted = np.array([p.filter.box() for p in others]).reshape(-1, 4)
    near = iou(box[None].astype(float), predicted)[0] > MIXED_IOU
    return any(p.similarity(appearance) > own + _SIMILARITY_MARGIN for p, at in zip(others, near, strict=True) if at)


def same_person(lost: Person, person: Person, left_image: bool) -> bool:
    """Whether a new track fits the lost subject's appearance, and its distance and size the elapsed time."""
    gap = (person.first_ns - lost.confirmed_ns) * 1e-9
    if gap > FORGET_S:
        return False
    start, end = lost.box, person.box
    length = max(lost.filter.length, 1.0)
    distance = float(np.linalg.norm((start[:2] + start[2:] - end[:2] - end[2:]) / 2)) / length
    growth = abs(float(np.log(max(end[3] - end[1], end[2] - end[0], 1.0) / length)))
    similarity = person.similarity(lost.appearance)
    if left_image:  # re-entry at the place of leaving, at half the usual difference of appearance
        return distance < 1.5 and similarity >= 0.5 * (1 + _REIDENTIFY_SIMILARITY)
    return distance < 1.0 + 1.5 * gap and growth < 0.5 + 0.3 * gap and similarity >= _REIDENTIFY_SIMILARITY


def leaving(person: Person, image_shape: tuple[int, ...]) -> bool:
    """Whether the person's last box touches an edge of the image and moves outwards."""
    height, width = image_shape[:2]
    edge = 0.01 * max(width, height)
    x0, y0, x1, y1 = person.box
    vx, vy = person.filter.x[:2, 1] / person.filter.length
    out = ((x0 < edge, -vx), (x1 > width - edge, vx), (y0 < edge, -vy), (y1 > height - edge, vy))
    return any(at_edge and speed > _LEAVING_SPEED for at_edge, speed in out)
