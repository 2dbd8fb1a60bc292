"""Poses of others than the subject: whether they are persons, and one of them the lost subject."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, BodyPose, BodyPoseModel
from drocap_ros.perception.tracking.camera_motion import sweeps
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, SURE_CONFIDENCE, Person, Subject
from drocap_ros.perception.tracking.search import FULL_EVERY_NS, SEARCH_EVERY_NS
from drocap_ros.perception.tracking.subject import SubjectTracker

_MOST = 2  # poses of others per image while there is no subject, or of other boxes around it
_BETTER = 0.1  # confidence by which the pose in another box around the subject has to exceed the one in its own


class OtherPoses:
    """Estimates the poses of few others per image; the tracker judges persons by them."""

    def __init__(self, tracker: SubjectTracker, model: BodyPoseModel) -> None:
        self._tracker, self._model = tracker, model

    def best(
        self, image: np.ndarray, stamp_ns: int, subject: Subject, pose: BodyPose, shedding: bool
    ) -> tuple[Subject, BodyPose]:
        """Subject and pose, or those of another box around it in whose pose the belief is clearly greater."""
        known = self._tracker.subject
        if known is None or subject.score == 0:
            return subject, pose
        belief = pose.belief(image, subject.box) * known.pose.fit(pose.limbs(), stamp_ns)
        if belief >= CLEAR_CONFIDENCE:
            return subject, pose
        for box, score in self._tracker.other_boxes(subject)[: 1 if shedding else _MOST]:
            other = self._model.estimate(image, box)
            others = other.belief(image, box) * known.pose.fit(other.limbs(), stamp_ns)
            if others >= max(CONFIRM_CONFIDENCE, belief + _BETTER):
                subject, pose, belief = self._tracker.correct(subject, box, score), other, others
        return subject, pose

    def judge(
        self, image: np.ndarray, stamp_ns: int, subject: BodyPose | None, motion: np.ndarray | None, shedding: bool
    ) -> None:
        """Let the tracker know the poses of others: whether they are persons, and not the subject again.

        subject : its pose in the same image; None without one
        motion : (2, 3) of the image by the camera's, or None
        """
        for person in due_bystanders(self._tracker, stamp_ns, shedding)[: 1 if subject is not None else _MOST]:
            pose = self._model.estimate(image, person.box)
            same = subject is not None and pose.same_person(subject)
            belief, blurred = pose.belief(image, person.box), sweeps(motion, person.box)
            self._tracker.judge_bystander(person, belief, stamp_ns, same, blurred, pose.limbs())


def due_bystanders(tracker: SubjectTracker, stamp_ns: int, shedding: bool = False) -> list[Person]:
    """Persons detected in this image whose poses are due, the oldest first; none beside a subject in doubt.

    shedding : only those who are not yet known to be someone else
    """
    subject = tracker.subject
    searching = subject is None or subject.detected_ns != stamp_ns
    choosing = subject is None or subject.nobody
    if subject is not None and not (searching or choosing) and subject.pose.believed_ns != stamp_ns:
        return []
    closely = searching or (subject is not None and tracker.choice.is_open(subject, stamp_ns))
    known = subject.others if shedding and subject is not None else ()
    due = [
        p
        for p in tracker.detected(stamp_ns)
        if p not in known and _due(p, closely or not tracker.apart(p), choosing, stamp_ns)
    ]
    return sorted(due, key=lambda p: (p.pose.judged_ns or 0, -p.filter.length))


def _due(person: Person, searching: bool, choosing: bool, stamp_ns: int) -> bool:
    """Whether a person has been seen more than once, and its last pose is old."""
    judged_ns = person.pose.judged_ns
    if judged_ns is None or choosing:
        return choosing or person.hits > 1
    # A person who comes out of cover shows more joints in every image.
    if searching and CONFIRM_CONFIDENCE <= person.pose.last < SURE_CONFIDENCE:
        return True
    return stamp_ns - judged_ns >= (SEARCH_EVERY_NS if searching else FULL_EVERY_NS)
