"""Second boxes around the subject: a detector that doubts the extent of a person gives two of it.

As a bystander the second one would take the next detections from the subject and hide it; and a person in view together
with the subject is never the subject again.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.tracking.person import Person

#: Overlap coefficient below which two boxes hold two persons, if each holds one.
_APART = 0.5
#: Overlap and similarity from which a new track beside the detected subject is a second box.
_IOU, _SIMILARITY = 0.35, 0.93


def apart(person: Person, subject: Person) -> bool:
    """Whether the two boxes hardly overlap."""
    return bool(overlap_coefficient(person.box[None], subject.box[None])[0, 0] < _APART)


def compare(person: Person, subject: Person | None, appearance: np.ndarray | None) -> None:
    """Mark a new track that began at the place of the subject, detected in the same image, and looks like it."""
    if subject is None or subject.detected_ns != person.detected_ns:
        return
    person.began_at_subject = not apart(person, subject)
    overlap = float(iou(person.box[None], subject.box[None])[0, 0])
    person.double = appearance is not None and overlap > _IOU and subject.similarity(appearance) > _SIMILARITY


def on_joints(person: Person, subject: Person, same: bool) -> None:
    """Mark a certain person by its joints, seen in the same image as the certain subject's.

    same : whether they are the subject's.  Whoever came from elsewhere is someone else all the same: a pose found
        behind the subject is the subject's
    """
    # Of two boxes in each other one may hold the person and its shadow.
    person.pose.other |= apart(person, subject)
    person.double |= same and person.began_at_subject


def on_detections(persons: list[Person], subject: Person | None, stamp_ns: int) -> None:
    """Unmark those who came out from behind the subject: both were detected, apart from each other."""
    if subject is None or subject.detected_ns != stamp_ns:
        return
    for person in persons:
        if person.began_at_subject and person.detected_ns == stamp_ns and apart(person, subject):
            person.began_at_subject = person.double = False
