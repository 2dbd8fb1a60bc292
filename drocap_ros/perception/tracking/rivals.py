"""Rivals of a doubtful subject: detections that could be the subject instead of the box that it was given."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.person import Person, boxes_of
from drocap_ros.perception.tracking.pose_belief import CONFIRM_CONFIDENCE, SURE_CONFIDENCE
from drocap_ros.perception.tracking.reidentification import MIXED_IOU

#: Confidence by which a rival's pose has to exceed the subject's.
_BETTER = 0.15
#: Reach of the subject from its last believable box: lengths, and lengths per second since.
_REACH, _REACH_PER_S = 1.0, 1.2
#: The same for the logarithm of the size.
_GROWTH, _GROWTH_PER_S = 0.8, 0.4
#: Longest time over which the reach grows.
_LONGEST_S = 3.0
#: Overlap from which two boxes are the same, and overlap coefficient from which one lies in the other.
_SAME, _INSIDE = 0.6, 0.7
#: Interval of the poses of a bystander beside the subject, and without one.
_JUDGE_EVERY_NS, _SEARCH_EVERY_NS = 1_000_000_000, 300_000_000
#: Least similarity with the subject, and how much less similar than the subject's present box a rival may be.
_SIMILARITY, _LESS_SIMILAR = 0.75, 0.02


def wins(rival: float, subject: float) -> bool:
    """Whether a rival's pose confidence is so much better that it is the subject."""
    return rival >= max(CONFIRM_CONFIDENCE, subject + _BETTER)


def rivals(
    subject: Person,
    persons: list[Person],
    image: np.ndarray,
    boxes: np.ndarray,
    scores: np.ndarray,
    confidence: float,
    stamp_ns: int,
) -> list[int]:
    """Indices of the boxes (N, 4) px of scores (N,) that could show the subject, the nearest and best first.

    image : (H, W, 3) uint8 BGR
    confidence : of the subject's pose in this image
    """
    found: list[int] = []
    if not len(boxes) or _covered(subject, persons, stamp_ns):
        return found
    present = describe(image, subject.box)
    for j, box in enumerate(np.asarray(boxes, float)):
        if _overlap(box, subject.box) > _SAME or not _in_reach(subject, box, confidence, stamp_ns):
            continue
        if _on_other(subject, persons, box, stamp_ns):
            continue
        # A box around person and shadow has the colours of both: inside it they say nothing.
        inside = float(overlap_coefficient(box[None], subject.box[None])[0, 0]) > _INSIDE
        if inside or _looks_right(subject, describe(image, box), present):
            found.append(j)
    predicted = subject.filter.box()
    offset = (predicted[:2] + predicted[2:] - boxes[:, :2] - boxes[:, 2:]) / 2
    lengths = np.round(np.linalg.norm(offset, axis=1) / max(subject.filter.length, subject.pose.length))
    return sorted(found, key=lambda j: (lengths[j], -scores[j]))


def _on_other(subject: Person, persons: list[Person], box: np.ndarray, stamp_ns: int) -> bool:
    """Whether a box (4,) px lies on someone else who was detected in this image: it may be a second box around them."""
    others = [p for p in persons if p is not subject and p.pose.other and p.plausible and p.detected_ns == stamp_ns]
    return bool((overlap_coefficient(box[None], boxes_of(others)) > _INSIDE).any())


def _covered(subject: Person, persons: list[Person], stamp_ns: int) -> bool:
    """Whether a subject without detection stands at another person's place: a clear pose there is that person's."""
    if subject.detected_ns == stamp_ns:
        return False
    others = [p for p in persons if p is not subject and p.plausible and not p.double and p.detected_ns == stamp_ns]
    return bool((overlap_coefficient(subject.filter.box()[None], boxes_of(others)) > MIXED_IOU).any())


def _in_reach(subject: Person, box: np.ndarray, confidence: float, stamp_ns: int) -> bool:
    """Whether the subject can have come to a box (4,) px since its last believable pose.

    A subject without one has no place yet: every box is in reach.
    """
    last, since_ns = subject.pose.box, subject.pose.believed_ns
    if last is None or since_ns is None:
        if confidence < CONFIRM_CONFIDENCE:
            return True
        last, since_ns = subject.box, stamp_ns
    gap = min((stamp_ns - since_ns) * 1e-9, _LONGEST_S)
    length = max(float((last[2:] - last[:2]).max()), subject.pose.length, 1.0)
    distance = float(np.linalg.norm((last[:2] + last[2:] - box[:2] - box[2:]) / 2)) / length
    growth = subject.pose.growth(box, length)
    return distance < _REACH + _REACH_PER_S * gap and growth < _GROWTH + _GROWTH_PER_S * gap


def owner_of(box: np.ndarray, persons: list[Person], stamp_ns: int) -> Person | None:
    """The person who was detected at a box (4,) px in this image."""
    detected = [p for p in persons if p.detected_ns == stamp_ns and _overlap(box, p.box) > _SAME]
    return max(detected, key=lambda p: _overlap(box, p.box), default=None)


def _looks_right(subject: Person, rival: np.ndarray | None, present: np.ndarray | None) -> bool:
    """Whether a rival's appearance fits the subject, not less than that of the box which the subject has at present."""
    if not subject.appearance_settled or rival is None:
        return True
    similarity = subject.similarity(rival)
    return similarity >= _SIMILARITY and similarity >= subject.similarity(present) - _LESS_SIMILAR


def _overlap(box: np.ndarray, other: np.ndarray) -> float:
    return float(iou(np.asarray(box, float)[None], np.asarray(other, float)[None])[0, 0])


def clutter_of(subject: Person, stamp_ns: int) -> Person:
    """A track of what the subject's box shows: no person."""
    clutter = Person(subject.box, subject.score, stamp_ns, None)
    clutter.pose.refute(subject.pose.value, stamp_ns)
    return clutter


def due_bystander(
    subject: Person | None, persons: list[Person], stamp_ns: int, shedding: bool = False
) -> Person | None:
    """The person detected in this image whose last pose is the oldest, beside a certain subject or without one.

    shedding : only one who is not yet known to be someone else
    """
    if subject is not None and subject.detected_ns == stamp_ns and subject.pose.believed_ns != stamp_ns:
        return None
    seen = [p for p in persons if p is not subject and p.detected_ns == stamp_ns and p.hits > 1 and not p.double]
    if shedding:
        seen = [p for p in seen if not p.pose.other]
    searching = subject is None or subject.detected_ns != stamp_ns
    due = [p for p in seen if p.pose.judged_ns is None or stamp_ns - p.pose.judged_ns >= _interval_ns(p, searching)]
    return min(due, key=lambda p: p.pose.judged_ns or 0, default=None)


def _interval_ns(person: Person, searching: bool) -> int:
    if not searching:
        return _JUDGE_EVERY_NS
    # A person who comes out of cover shows more joints in every image.
    return 0 if CONFIRM_CONFIDENCE <= person.pose.last < SURE_CONFIDENCE else _SEARCH_EVERY_NS
