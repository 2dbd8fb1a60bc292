"""Poses of others than the subject: boxes that a doubtful subject may be instead, and bystanders."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, BodyPose, BodyPoseModel
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.camera_motion import moved_box, sweeps
from drocap_ros.perception.tracking.identity import MIXED_IOU
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, SURE_CONFIDENCE, Person, Subject, boxes_of
from drocap_ros.perception.tracking.subject import SAME_BOX_IOU, SubjectTracker

_MOST = 2  # poses of such boxes per image,
_MOST_SHEDDING = 1  # and under load shedding
_REJECTED_NS = 300_000_000  # time for which a box that lost is not looked at again
_BETTER = 0.15  # confidence by which a pose has to exceed the subject's
_REACH = 1.0  # of the subject from its last believable box, lengths,
_REACH_PER_S = 1.2  # and lengths per second since
_GROWTH = 0.8  # the same for the logarithm of the size,
_GROWTH_PER_S = 0.4  # and per second since
_LONGEST_S = 3.0  # time over which both grow
_INSIDE = 0.7  # overlap coefficient from which one box lies in the other
_SIMILARITY = 0.75  # least similarity with the subject,
_LESS_SIMILAR = 0.02  # and how much less similar than the subject's present box a box may be
_JUDGE_EVERY_NS = 1_000_000_000  # interval of the poses of a bystander beside the subject,
_SEARCH_EVERY_NS = 300_000_000  # and without one


class OtherPoses:
    """Estimates the poses of few others per image; the tracker judges persons by them."""

    def __init__(self, tracker: SubjectTracker, model: BodyPoseModel) -> None:
        self._tracker, self._model = tracker, model
        #: Boxes (4,) px and stamps of those that lost lately.
        self._rejected: list[tuple[np.ndarray, int]] = []

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        self._rejected = [(moved_box(matrix, box), at_ns) for box, at_ns in self._rejected]

    def compete(
        self, image: np.ndarray, stamp_ns: int, subject: Subject, pose: BodyPose, found: Detections, shedding: bool
    ) -> tuple[Subject, BodyPose]:
        """Subject and pose, or those of a detection in whose pose the belief is clearly greater: it was a shadow."""
        belief = pose.belief(image, subject.box)
        if belief >= CLEAR_CONFIDENCE:
            return subject, pose
        boxes = found.boxes.astype(float)
        # Of a box around person and shadow, the clear joints are the person's.
        if subject.score > 0 and (around := pose.box(CONFIRM_CONFIDENCE, 0.4)) is not None:
            boxes = np.concatenate([boxes, [around]])
        scores = np.append(found.scores, subject.score)[: len(boxes)]
        for j in self._worth_a_pose(image, stamp_ns, boxes, scores, belief)[: _MOST_SHEDDING if shedding else _MOST]:
            other = self._model.estimate(image, boxes[j])
            others_belief = other.belief(image, boxes[j])
            if others_belief >= max(CONFIRM_CONFIDENCE, belief + _BETTER):
                subject = self._tracker.exchange(image, stamp_ns, boxes[j], float(scores[j]))
                pose, belief = other, others_belief
            else:
                self._rejected.append((boxes[j], stamp_ns))
        return subject, pose

    def _worth_a_pose(
        self, image: np.ndarray, stamp_ns: int, boxes: np.ndarray, scores: np.ndarray, belief: float
    ) -> list[int]:
        """Boxes that the subject may be, without those that lost lately."""
        self._rejected = [(box, ns) for box, ns in self._rejected if stamp_ns - ns < _REJECTED_NS]
        known = np.array([box for box, _ in self._rejected]).reshape(-1, 4)
        possible = possible_subjects(self._tracker, image, Detections(boxes, scores), belief, stamp_ns)
        return [j for j in possible if not (iou(boxes[j][None], known) > SAME_BOX_IOU).any()]

    def judge_bystander(
        self, image: np.ndarray, stamp_ns: int, subject: BodyPose | None, motion: np.ndarray | None, shedding: bool
    ) -> None:
        """Let the tracker know the pose of at most one other person: whether it is one, and not the subject again.

        motion : (2, 3) of the image by the camera's, or None
        """
        person = due_bystander(self._tracker, stamp_ns, shedding)
        if person is not None:
            pose = self._model.estimate(image, person.box)
            same = subject is not None and pose.same_person(subject)
            blurred = sweeps(motion, person.box)
            self._tracker.judge_bystander(person, pose.belief(image, person.box), stamp_ns, same, blurred)


def possible_subjects(
    tracker: SubjectTracker, image: np.ndarray, found: Detections, confidence: float, stamp_ns: int
) -> list[int]:
    """Indices of the detections that could show the subject instead of its box, the nearest and best first.

    image : (H, W, 3) uint8 BGR
    confidence : mean of the subject's pose in this image
    """
    subject = tracker.subject
    if subject is None or not len(found):
        return []
    detected = [p for p in tracker.persons if p is not subject and p.plausible and p.detected_ns == stamp_ns]
    if subject.detected_ns != stamp_ns and _overlap_any(subject.filter.box(), detected, MIXED_IOU, doubles=False):
        return []  # without detection, at another person's place: a clear pose there is that person's
    others = [p for p in detected if p.pose.other]
    present = describe(image, subject.box)
    possible: list[int] = []
    for j, box in enumerate(np.asarray(found.boxes, float)):
        if iou(box[None], subject.box[None])[0, 0] > SAME_BOX_IOU or not _in_reach(subject, box, confidence, stamp_ns):
            continue
        if _overlap_any(box, others, _INSIDE):
            continue  # it may be a second box around someone else
        # A box around person and shadow has the colours of both: inside it they say nothing.
        inside = float(overlap_coefficient(box[None], subject.box[None])[0, 0]) > _INSIDE
        if inside or _looks_right(subject, describe(image, box), present):
            possible.append(j)
    predicted = subject.filter.box()
    offset = (predicted[:2] + predicted[2:] - found.boxes[:, :2] - found.boxes[:, 2:]) / 2
    lengths = np.round(np.linalg.norm(offset, axis=1) / max(subject.filter.length, subject.pose.length))
    return sorted(possible, key=lambda j: (lengths[j], -found.scores[j]))


def _overlap_any(box: np.ndarray, persons: list[Person], least: float, doubles: bool = True) -> bool:
    boxes = boxes_of(p for p in persons if doubles or not p.double)
    return bool((overlap_coefficient(box[None], boxes) > least).any())


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


def _looks_right(subject: Person, other: np.ndarray | None, present: np.ndarray | None) -> bool:
    """Whether an appearance fits the subject, not less than that of the box which the subject has at present."""
    if not subject.appearance_settled or other is None:
        return True
    similarity = subject.similarity(other)
    return similarity >= _SIMILARITY and similarity >= subject.similarity(present) - _LESS_SIMILAR


def due_bystander(tracker: SubjectTracker, stamp_ns: int, shedding: bool = False) -> Person | None:
    """The person detected in this image whose last pose is the oldest, beside a certain subject or without one.

    shedding : only one who is not yet known to be someone else
    """
    subject = tracker.subject
    searching = subject is None or subject.detected_ns != stamp_ns
    if subject is not None and not searching and subject.pose.believed_ns != stamp_ns:
        return None

    def due(person: Person) -> bool:
        judged_ns = person.pose.judged_ns
        if judged_ns is None or not searching:
            return judged_ns is None or stamp_ns - judged_ns >= _JUDGE_EVERY_NS
        # A person who comes out of cover shows more joints in every image.
        coming_out = CONFIRM_CONFIDENCE <= person.pose.last < SURE_CONFIDENCE
        return coming_out or stamp_ns - judged_ns >= _SEARCH_EVERY_NS

    seen = [p for p in tracker.persons if p is not subject and p.detected_ns == stamp_ns and p.hits > 1]
    seen = [p for p in seen if not p.double and not (shedding and p.pose.other) and due(p)]
    return min(seen, key=lambda p: p.pose.judged_ns or 0, default=None)
