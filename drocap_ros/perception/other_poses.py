"""Poses of others than the subject: rivals that a doubtful subject may be instead, and bystanders."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.body_pose import CLEAR_CONFIDENCE, BodyPose, BodyPoseModel
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.tracking import Subject, SubjectTracker
from drocap_ros.perception.tracking.camera_motion import moved_box, sweeps
from drocap_ros.perception.tracking.pose_belief import CONFIRM_CONFIDENCE
from drocap_ros.perception.tracking.rivals import wins

#: Largest number of rivals of a doubtful subject whose poses one image looks at, and the same under load shedding.
_RIVALS, _FEW_RIVALS = 2, 1
#: Time for which a rival that lost is not looked at again, and the overlap from which a box is that rival's.
_REJECTED_NS, _SAME_IOU = 300_000_000, 0.6


class OtherPoses:
    """Estimates the poses of few others per image; the tracker judges persons by them."""

    def __init__(self, tracker: SubjectTracker, model: BodyPoseModel) -> None:
        self._tracker, self._model = tracker, model
        #: Boxes (4,) px and stamps of the rivals that lost lately.
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
        self._rejected = [(box, ns) for box, ns in self._rejected if stamp_ns - ns < _REJECTED_NS]
        known = np.array([box for box, _ in self._rejected]).reshape(-1, 4)
        rivals = self._tracker.rivals(image, stamp_ns, boxes, scores, belief)
        rivals = [j for j in rivals if not (iou(boxes[j][None], known) > _SAME_IOU).any()]
        for j in rivals[: _FEW_RIVALS if shedding else _RIVALS]:
            rival = self._model.estimate(image, boxes[j])
            rivals_belief = rival.belief(image, boxes[j])
            if wins(rivals_belief, belief):
                subject = self._tracker.exchange(image, stamp_ns, boxes[j], float(scores[j]))
                pose, belief = rival, rivals_belief
            else:
                self._rejected.append((boxes[j], stamp_ns))
        return subject, pose

    def judge_bystander(
        self, image: np.ndarray, stamp_ns: int, subject: BodyPose | None, motion: np.ndarray | None, shedding: bool
    ) -> None:
        """Let the tracker know the pose of at most one other person: whether it is one, and not the subject again.

        motion : (2, 3) of the image by the camera's, or None
        """
        person = self._tracker.bystander_to_judge(stamp_ns, shedding)
        if person is not None:
            pose = self._model.estimate(image, person.box)
            same = subject is not None and pose.same_person(subject)
            blurred = sweeps(motion, person.box)
            self._tracker.judge_bystander(person, pose.belief(image, person.box), stamp_ns, same, blurred)
