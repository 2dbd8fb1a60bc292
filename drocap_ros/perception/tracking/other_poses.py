"""Poses of others than the subject: boxes that a doubtful subject may be instead, and bystanders."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, BodyPose, BodyPoseModel
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import MIXED_IOU, could_be
from drocap_ros.perception.tracking.camera_motion import moved_box, sweeps
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
        first = belief = pose.belief(image, subject.box)
        if first >= CLEAR_CONFIDENCE:
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
            elif others_belief < max(CONFIRM_CONFIDENCE, first + _BETTER):  # not only than a better one of this image
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
    detected = tracker.detected(stamp_ns)
    others = [p for p in detected if p.other]
    if subject.detected_ns != stamp_ns and _overlap_any(subject.filter.box(), others, MIXED_IOU):
        return []  # without detection, at another person's place: a clear pose there is that person's
    boxes = np.asarray(found.boxes, float)
    free = np.nonzero(_free(subject, detected, boxes))[0].tolist()
    near = [j for j in free if _in_reach(subject, boxes[j], confidence, stamp_ns)]
    possible = _of_its_colours(subject, image, boxes, near)
    predicted = subject.filter.box()
    offset = (predicted[:2] + predicted[2:] - found.boxes[:, :2] - found.boxes[:, 2:]) / 2
    lengths = np.round(np.linalg.norm(offset, axis=1) / max(subject.filter.length, subject.pose.length))
    return sorted(possible, key=lambda j: (lengths[j], -found.scores[j]))


def _free(subject: Person, persons: list[Person], boxes: np.ndarray) -> np.ndarray:
    """(N,) bool: boxes that are neither the subject's own nor someone else's."""
    # A box on someone else may be a second one around them.
    certain = subject.pose.box is not None
    persons = [p for p in persons if p.plausible]
    known = [p for p in persons if p in subject.others or (certain and not could_be(subject, p))]
    others = overlap_coefficient(boxes, boxes_of(known)) > _INSIDE
    return np.asarray((iou(boxes, subject.box[None])[:, 0] <= SAME_BOX_IOU) & ~others.any(axis=1))


def _overlap_any(box: np.ndarray, persons: list[Person], least: float) -> bool:
    return bool((overlap_coefficient(box[None], boxes_of(persons)) > least).any())


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


def _of_its_colours(subject: Person, image: np.ndarray, boxes: np.ndarray, indices: list[int]) -> list[int]:
    """Those of the boxes whose appearance fits the subject, not less than that of its present box."""
    if not subject.appearance_settled:
        return indices
    least = max(_SIMILARITY, subject.similarity(describe(image, subject.box)) - _LESS_SIMILAR)
    fitting = []
    for j in indices:
        # A box around person and shadow has the colours of both: inside it they say nothing.
        inside = _overlap_any(boxes[j], [subject], _INSIDE)
        appearance = None if inside else describe(image, boxes[j])
        if appearance is None or subject.similarity(appearance) >= least:
            fitting.append(j)
    return fitting


def due_bystander(tracker: SubjectTracker, stamp_ns: int, shedding: bool = False) -> Person | None:
    """The person detected in this image whose last pose is the oldest, beside a certain subject or without one.

    shedding : only one who is not yet known to be someone else
    """
    subject = tracker.subject
    searching = subject is None or subject.detected_ns != stamp_ns
    if subject is not None and not searching and subject.pose.believed_ns != stamp_ns:
        return None
    known = subject.others if shedding and subject is not None else ()
    due = [p for p in tracker.detected(stamp_ns) if p not in known and _due(p, searching, stamp_ns)]
    return min(due, key=lambda p: p.pose.judged_ns or 0, default=None)


def _due(person: Person, searching: bool, stamp_ns: int) -> bool:
    """Whether a person has been seen more than once, and its last pose is old."""
    if person.hits < 2 or person.double:
        return False
    judged_ns = person.pose.judged_ns
    if judged_ns is None:
        return True
    # A person who comes out of cover shows more joints in every image.
    if searching and CONFIRM_CONFIDENCE <= person.pose.last < SURE_CONFIDENCE:
        return True
    return stamp_ns - judged_ns >= (_SEARCH_EVERY_NS if searching else _JUDGE_EVERY_NS)
