"""Several persons followed by their joints: who is where in each image, and whose each joint is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.detection.nms import overlap_coefficient
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, LEAST_BESIDE, BodyPose, BodyPoseModel, FeetModel
from drocap_ros.perception.tracking.appearance import describe, limb_colours
from drocap_ros.perception.tracking.association import FORGET_S, found_again
from drocap_ros.perception.tracking.own_joints import BodyTrack, Poses, own_joints
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, EMPTY_CONFIDENCE, Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15, BODY_19

_HIDDEN_S = 2.0  # time without own joints after which a person is sought elsewhere, too
_UNDETECTED_S = 3.0  # time without a detection over which doubtful poses are a person's
_OVERLAP = 0.02  # overlap coefficient of two boxes from which joints may be the other's
_LEAST_JOINTS = 4  # of BODY_15 that show a person
_SAME_BODY = 0.1  # median distance of two poses' joints, lengths, below which they are one person's


@dataclass(eq=False)
class Body:
    """A person who is followed, and the observation of the newest image in which its joints were seen."""

    track: BodyTrack
    seen: PoseObservation | None = None

    def shown(self, stamp_ns: int) -> bool:
        """Whether the image of this stamp shows its joints."""
        return self.seen is not None and self.seen.stamp_ns == stamp_ns


class Bodies:
    """Follows persons through the images of one camera; equal images give equal results.

    model, feet : the pose network, and the second one for feet or None
    threads : that share the work on an image; the results are the same with any number

    Attributes
    ----------
    people, gone : those who are followed; those who left the image or were hidden for long
    """

    def __init__(
        self, model: BodyPoseModel, feet: FeetModel | None, config: PoseEstimatorConfig, threads: int = 2
    ) -> None:
        self._model, self._feet, self._config = model, feet, config
        self.pool = ThreadPoolExecutor(threads, thread_name_prefix="people")
        self.people: list[Body] = []
        self.gone: list[Body] = []
        self._size = (0, 0)

    def predict(self, stamp_ns: int, motion: np.ndarray | None) -> None:
        """Expect everybody in the next image; ``motion`` (2, 3) of the image by the camera's, or None."""
        for one in self.people:
            if motion is not None:
                one.track.move_camera(motion)
            one.track.predict(stamp_ns)

    def observe(self, image: np.ndarray, stamp_ns: int, detected: list[Person]) -> list[tuple[Person, Body]]:
        """Find the joints of everybody in the image, and new persons among those detected; returns who is whom."""
        self._size = (image.shape[1], image.shape[0])
        boxes = [one.track.box for one in self.people]
        poses = list(self.pool.map(lambda one: self._model.estimate(image, one.track.box), self.people))
        for group in _groups(boxes):
            self._share(image, stamp_ns, [self.people[i] for i in group], [poses[i] for i in group])
        matches = []
        for person in detected:
            shown = [one for one in self.people if one.shown(stamp_ns) and one.track.on(person.box)]
            best = max(shown, key=lambda one: one.track.overlap(person.box), default=None)
            if best is None:
                best = self._begin(image, stamp_ns, person)
            if best is not None:
                matches.append((person, best))
                best.track.detected_ns = stamp_ns
        self._lose(stamp_ns)
        return matches

    def _share(self, image: np.ndarray, stamp_ns: int, group: list[Body], poses: list[BodyPose]) -> None:
        """Give the joints of poses in the boxes of overlapping persons to those whose they are."""
        count = len(self._model.joint_map.joints)
        if len(group) == 1:
            pose, joint = np.zeros(1, int), np.zeros((1, count), int)
        else:
            colours = [self._colours(image, one, pose.xy) for one, pose in zip(group, poses, strict=True)]
            given = Poses(*(np.array(v) for v in ([p.xy for p in poses], [p.confidence for p in poses], colours)))
            pose, joint = own_joints([one.track for one in group], given)
        for k, one in enumerate(group):
            if pose[k] >= 0:
                others = [other.track.box for other in group if other is not one]
                taken = self._take(image, stamp_ns, one, poses, joint[k], others)
                if taken is not None:
                    one.seen = self._observation(image, stamp_ns, one, taken)

    def _colours(self, image: np.ndarray, one: Body, xy: np.ndarray) -> np.ndarray:
        return limb_colours(image, xy, self._model.joint_map.joints, one.track.length)

    def _take(
        self,
        image: np.ndarray,
        stamp_ns: int,
        one: Body,
        poses: list[BodyPose],
        joint: np.ndarray,
        others: list[np.ndarray],
    ) -> BodyPose | None:
        """Take over the joints (P,) of poses that are a person's, beside others in boxes (4,) px; None = too few."""
        track, at = one.track, np.arange(len(joint))
        given = np.maximum(joint, 0)
        xy, covariance, confidence = (
            np.array([getattr(pose, name) for pose in poses])[given, at] for name in ("xy", "covariance", "confidence")
        )
        inside = ((xy >= 0) & (xy < np.array(self._size))).all(axis=1)
        free = np.ones(len(xy), bool)
        for other in others:
            free &= ((xy < other[:2]) | (xy > other[2:])).any(axis=1)
        least = np.where(free, self._config.keypoint_threshold, LEAST_BESIDE)
        own = (joint >= 0) & inside & (confidence >= least)
        believed = float(np.where(own, confidence, 0.0)[: len(BODY_15)].mean())
        recent = (stamp_ns - track.detected_ns) * 1e-9 <= _UNDETECTED_S
        needed = 0.0 if recent and others else EMPTY_CONFIDENCE if recent else CLEAR_CONFIDENCE
        sure = own & (confidence >= EMPTY_CONFIDENCE)
        if believed < needed or sure[: len(BODY_15)].sum() < _LEAST_JOINTS:
            return None
        track.accept(xy, sure, believed >= EMPTY_CONFIDENCE)
        box = track.box
        track.person.filter.predict(stamp_ns)
        track.person.update(box, track.person.score, stamp_ns)
        track.person.confirm(stamp_ns)
        track.person.pose.judge(believed, box, stamp_ns)
        if believed >= CONFIRM_CONFIDENCE:
            if not others:
                track.person.update_appearance(describe(image, box))
            track.look(self._colours(image, one, np.where(sure[:, None], xy, np.nan)), free)
        return BodyPose(xy, covariance, confidence * own, poses[0].network)

    def _observation(self, image: np.ndarray, stamp_ns: int, one: Body, pose: BodyPose) -> PoseObservation:
        """A pose with the person's own joints, those of its feet by the second network; others have no confidence."""
        box, joints = one.track.box, self._model.joint_map.joints
        if self._feet is not None:
            pose, joints = self._feet.add(image, box, pose), BODY_19
        inside = ((pose.xy >= 0) & (pose.xy < np.array(self._size))).all(axis=1)
        seen = inside & (pose.confidence > 0) & (pose.confidence >= self._config.keypoint_threshold)
        blank = np.where(seen, 1.0, np.nan)[:, None]
        xy, covariance = (pose.xy * blank).astype(np.float32), (pose.covariance * blank).astype(np.float32)
        confidence = np.where(seen, pose.confidence, 0.0).astype(np.float32)
        score, space = one.track.person.score, None if pose.space is None else pose.space.astype(np.float32)
        return PoseObservation(
            stamp_ns, 1, self._size, joints, box.astype(np.float32), score, xy, covariance, confidence, space=space
        )

    def _begin(self, image: np.ndarray, stamp_ns: int, found: Person) -> Body | None:
        """Whom a detection shows that is nobody's who is in view: one who was hidden or gone, or someone new."""
        pose = self._model.estimate(image, found.box)
        if pose.belief(image, found.box) < CONFIRM_CONFIDENCE or self._is_followed(pose, stamp_ns):
            return None
        person = Person(found.box, found.score, stamp_ns, describe(image, found.box))
        person.hits = found.hits
        person.pose.judge(pose.mean_confidence, found.box, stamp_ns)
        one = Body(BodyTrack(person, pose, self._model.joint_map.joints, stamp_ns))
        again = self._again(one, stamp_ns)
        if again is not None:
            again.track.continue_as(one.track)
            one = again
        if one not in self.people:
            self.people.append(one)
            self.gone = [other for other in self.gone if other is not one]
        taken = self._take(image, stamp_ns, one, [pose], np.zeros((len(pose.confidence)), int), [found.box])
        if taken is not None:
            one.seen = self._observation(image, stamp_ns, one, taken)
        return one

    def _again(self, one: Body, stamp_ns: int) -> Body | None:
        """Who of those out of view a new track shows."""
        hidden = [other for other in self.people if not other.shown(stamp_ns)]
        here = [other for other in hidden if other.track.on(one.track.person.box)]
        if here:
            return max(here, key=lambda other: other.track.person.similarity(one.track.person.appearance))
        for lost in (*hidden, *self.gone):
            if found_again(lost.track.person, [one.track.person], 1, stamp_ns):
                return lost
        return None

    def _is_followed(self, pose: BodyPose, stamp_ns: int) -> bool:
        """Whether these joints are already someone's."""
        seen = pose.confidence >= EMPTY_CONFIDENCE
        for one in self.people:
            if one.seen is not None and one.shown(stamp_ns):
                apart = np.linalg.norm(one.seen.keypoints[: len(pose.xy)] - pose.xy, axis=1)[seen]
                if np.median(np.nan_to_num(apart, nan=np.inf)) < _SAME_BODY * one.track.length:
                    return True
        return False

    def _lose(self, stamp_ns: int) -> None:
        """Give up who has not been seen for long, or has left the image; who is in view together is not the same."""
        shown = [one.track.person for one in self.people if one.shown(stamp_ns)]
        for person in shown:
            person.others.update(p for p in shown if p is not person)
        image = np.array([[0.0, 0.0, *self._size]])
        for one in list(self.people):
            hidden_s = (stamp_ns - one.track.seen_ns) * 1e-9
            outside = overlap_coefficient(one.track.box[None], image)[0, 0] < 0.3
            if hidden_s > _HIDDEN_S or (outside and hidden_s > 0):
                self.people.remove(one)
                self.gone.append(one)

    def forget(self, stamp_ns: int) -> None:
        """Keep nothing of those who are not found again any more."""
        self.gone = [one for one in self.gone if (stamp_ns - one.track.person.certain_ns) * 1e-9 <= FORGET_S]
        known = {one.track.person for one in (*self.people, *self.gone)}
        for person in known:
            person.others &= known


def _groups(boxes: list[np.ndarray]) -> list[list[int]]:
    """Indices of boxes (4,) px that overlap, directly or by others."""
    left, groups = list(range(len(boxes))), []
    near = overlap_coefficient(np.array(boxes).reshape(-1, 4), np.array(boxes).reshape(-1, 4)) > _OVERLAP
    while left:
        group = [left.pop(0)]
        for i in group:
            group += (more := [j for j in left if near[i, j]])
            left = [j for j in left if j not in more]
        groups.append(sorted(group))
    return groups
