"""All persons of a recording: numbered for the choice of a subject, and the joints of each in one pass."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FixedPoints, of_images
from drocap_ros.clip import Clip
from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.detection.nms import MOSTLY, iou, overlap_coefficient
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, LEAST_BESIDE, SEEN, BodyPose
from drocap_ros.perception.scene import JITTER_NS
from drocap_ros.perception.sources.base import Frame, prefetch, with_next
from drocap_ros.perception.track_video import tracks_from_observations
from drocap_ros.perception.tracking.appearance import describe, limb_colours
from drocap_ros.perception.tracking.association import found_again
from drocap_ros.perception.tracking.own_joints import LEAST_JOINTS, ExpectedJoints, Poses, own_joints
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, DOUBT_S, Person, Subject
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

#: Least interval of the detections: a walking person moves by a fifth of the length.
_EVERY_NS = 200_000_000 - JITTER_NS
_LEAST_SCORE = 0.45  # least recent mean score of a person; clutter and parts of bodies lie below
_OVERLAP = 0.02  # overlap coefficient of two boxes from which joints may be the other's
_SAME_BODY = 0.1  # median distance of two poses' joints, lengths, below which they are one person's


@dataclass(frozen=True)
class FoundPerson:
    """One person: ``boxes`` holds (4,) x_min y_min x_max y_max px by the stamps of its detections."""

    number: int
    boxes: dict[int, np.ndarray]

    @property
    def first_ns(self) -> int:
        """Stamp of the first detection."""
        return min(self.boxes)

    @property
    def last_ns(self) -> int:
        """Stamp of the last detection."""
        return max(self.boxes)

    def within(self, clip: Clip, begin_ns: int) -> FoundPerson | None:
        """The person in a part of the recording, whose first image has the stamp ``begin_ns``; None outside."""
        boxes = {stamp_ns: box for stamp_ns, box in self.boxes.items() if clip.holds(stamp_ns - begin_ns)}
        return dataclasses.replace(self, boxes=boxes) if boxes else None


def find_persons(
    frames: Iterable[Frame],
    models_dir: str | Path,
    config: PoseEstimatorConfig,
    on_frame: Callable[[Frame, None], None] | None = None,
) -> list[FoundPerson]:
    """Persons of a recording, as :class:`PeopleEstimator` finds them without the joints."""
    people = PeopleEstimator(models_dir, config)
    for frame in prefetch(frames):
        if on_frame is not None:
            on_frame(frame, None)
        people.find(frame)
    people.close()
    return list(people.numbered().values())


def in_view(persons: Sequence[Person], stamp_ns: int) -> int:
    """Number of persons detected in the image of this stamp and in one before."""
    return sum(p.detected_ns == stamp_ns and p.hits > 1 and p.mean_score >= _LEAST_SCORE for p in persons)


def following(config: PoseEstimatorConfig, persons: Sequence[FoundPerson], number: int) -> PoseEstimatorConfig:
    """Parameters to follow one of the persons from its first detection on."""
    person = next((person for person in persons if person.number == number), None)
    if person is None:
        there = f"{persons[0].number} to {persons[-1].number}"
        raise InputError(f"--subject {number}: expected {there}; `drocap track --list` numbers the persons of a part")
    box = ",".join(f"{value:.2f}" for value in person.boxes[person.first_ns])
    return dataclasses.replace(config, subject="box", subject_box=box, on_loss="wait")


class PeopleEstimator:
    """Follows all persons through the images of one camera; equal images give equal results.

    Everybody is a track of the tracker that follows a subject, here without one.  Five detections a second find the
    persons, and the joints of each say where it is in between.  A person that leaves the image and returns later gets
    another number; its joints are found to be the first one's.

    threads : that share the work on an image; the results are the same with any number
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig, threads: int = 2) -> None:
        # Without a box of the drone the rule `roi` never chooses a subject: all persons are bystanders.
        self._estimator = PoseEstimator(models_dir, dataclasses.replace(config, subject="roi", subject_box=""))
        self._config, self._tracker = config, self._estimator.tracker
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="people")
        self._joint_set = self._estimator.body.joint_map.joints
        self._detected_ns: int | None = None
        self._detections = 0
        #: Boxes of each track, by the stamps of its detections.
        self._boxes: dict[Person, dict[int, np.ndarray]] = {}
        #: The person's first track, of one in which it was found again.
        self._first: dict[Person, Person] = {}
        #: Of each person's first track the observations of the images that show its joints, by stamp.
        self._seen: dict[Person, dict[int, PoseObservation]] = {}
        self._stamps: list[int] = []
        self._points: list[FixedPoints | None] = []
        self._size = (0, 0)

    def find(self, frame: Frame) -> None:
        """Find the persons in an image, if one is due, without the joints of each."""
        if not self._due(frame.stamp_ns):
            return
        self._estimator.begin(frame.image, frame.stamp_ns)
        self._detect(frame.image, frame.stamp_ns)
        self._estimator.others.judge(frame.image, frame.stamp_ns, None, self._estimator.motion, shedding=False)
        self._estimator.end()

    def _due(self, stamp_ns: int) -> bool:
        """Whether the image of this time is one in which persons are sought."""
        last_ns = self._detected_ns
        return last_ns is None or stamp_ns < last_ns or stamp_ns - last_ns >= _EVERY_NS

    def _detect(self, image: np.ndarray, stamp_ns: int) -> list[Person]:
        """Update everybody with detections; returns those who have one."""
        self._detected_ns = stamp_ns
        self._detections += 1
        found = self._estimator.search.detect(image, stamp_ns, shedding=False, close=False)
        self._tracker.update(image, stamp_ns, found.boxes, found.scores)
        # A track that clutter has taken over is a person's up to there.
        detected = [p for p in self._tracker.detected(stamp_ns) if p.mean_score >= _LEAST_SCORE]
        for person in detected:
            self._boxes.setdefault(person, {})[stamp_ns] = person.box
        return detected

    def numbered(self) -> dict[Person, FoundPerson]:
        """The tracks in the order of their appearance, then from left to right."""
        least = min(self._config.confirm_frames, self._detections)
        found = [(person, boxes) for person, boxes in self._boxes.items() if len(boxes) >= least]
        if not found:
            raise InputError(
                f"expected a person in view, found none in {self._detections} images; try another video or model"
            )
        found.sort(key=lambda entry: (min(entry[1]), float(entry[1][min(entry[1])][0])))
        return {person: FoundPerson(number, boxes) for number, (person, boxes) in enumerate(found, 1)}

    def process(self, frame: Frame, ahead: Frame | None = None) -> list[PoseObservation]:
        """The persons whose joints an image shows; ``track_id`` counts them up.

        ahead : the next image, the one of the next call
        """
        image, stamp_ns = frame.image, frame.stamp_ns
        self._size = (image.shape[1], image.shape[0])
        scene = self._estimator.begin(image, stamp_ns, ahead)
        detected = self._detect(image, stamp_ns) if self._due(stamp_ns) else []
        followed = self._followed()
        for _, joints in followed:
            joints.predict(stamp_ns)
        poses = list(self._pool.map(lambda one: self._estimator.body.estimate(image, one[1].box), followed))
        for group in _groups([joints.box for _, joints in followed]):
            self._share(image, stamp_ns, [followed[i] for i in group], [poses[i] for i in group])
        for person in detected:
            if person.joints is None or person.joints.seen_in(stamp_ns) is None:
                self._begin(image, stamp_ns, person)
            if person.joints is not None and person.joints.seen_in(stamp_ns) is not None:
                person.joints.detected_ns = stamp_ns
        self._estimator.end()
        self._stamps.append(stamp_ns)
        self._points.append(scene.points)
        shown = {person: seen for person, joints in self._followed() if (seen := joints.seen_in(stamp_ns)) is not None}
        for person, seen in shown.items():
            person.others.update(other for other in shown if other is not person)
            self._seen.setdefault(self._first.get(person, person), {})[stamp_ns] = seen
        return [replace(seen, track_id=i, background=scene.points) for i, seen in enumerate(shown.values(), 1)]

    def _followed(self) -> list[tuple[Person, ExpectedJoints]]:
        return [(person, person.joints) for person in self._tracker.persons if person.joints is not None]

    def _share(
        self, image: np.ndarray, stamp_ns: int, group: list[tuple[Person, ExpectedJoints]], poses: list[BodyPose]
    ) -> None:
        """Give the joints of poses in the boxes of overlapping persons to those whose they are."""
        if len(group) == 1:
            pose, joint = np.zeros(1, int), np.zeros((1, len(self._joint_set)), int)
        else:
            pairs = zip(group, poses, strict=True)
            colours = [limb_colours(image, p.xy, self._joint_set, joints.length) for (_, joints), p in pairs]
            given = Poses(*(np.array(v) for v in ([p.xy for p in poses], [p.confidence for p in poses], colours)))
            pose, joint = own_joints([joints for _, joints in group], given)
        boxes = [joints.box for _, joints in group]
        for k, (person, joints) in enumerate(group):
            if pose[k] >= 0:
                others = boxes[:k] + boxes[k + 1 :]
                self._take(image, stamp_ns, (person, joints), poses, joint[k], others)

    def _take(
        self,
        image: np.ndarray,
        stamp_ns: int,
        one: tuple[Person, ExpectedJoints],
        poses: list[BodyPose],
        joint: np.ndarray,
        others: list[np.ndarray],
    ) -> None:
        """Take the joints (P,) of poses that are a person's, beside others in boxes (4,) px, if there are enough."""
        (person, expected), at = one, np.arange(len(joint))
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
        recent = (stamp_ns - expected.detected_ns) * 1e-9 <= DOUBT_S
        needed = 0.0 if recent and others else SEEN if recent else CLEAR_CONFIDENCE
        sure = own & (confidence >= SEEN)
        if believed < needed or sure[: len(BODY_15)].sum() < LEAST_JOINTS:
            return
        expected.accept(xy, sure, believed >= SEEN)
        box = expected.box
        person.measure(box, stamp_ns)
        person.pose.judge(believed, box, stamp_ns)
        if believed >= CONFIRM_CONFIDENCE:
            if not others:
                person.update_appearance(describe(image, box))
            expected.look(
                limb_colours(image, np.where(sure[:, None], xy, np.nan), self._joint_set, expected.length), free
            )
        pose = BodyPose(xy, covariance, confidence * own, poses[0].network)
        expected.seen = self._estimator.observation(image, stamp_ns, Subject(1, box, person.score, False), pose)

    def _begin(self, image: np.ndarray, stamp_ns: int, person: Person) -> None:
        """Begin with the joints of a detected person, perhaps a lost one, if they are nobody's who is in view."""
        shown = [joints.box for _, joints in self._followed() if joints.seen_in(stamp_ns) is not None]
        if (iou(person.box[None], np.array(shown).reshape(-1, 4)) > MOSTLY).any():
            return
        pose = self._estimator.body.estimate(image, person.box)
        belief = pose.belief(image, person.box)
        person.pose.judge(belief, person.box, stamp_ns)
        if belief < CONFIRM_CONFIDENCE or self._is_followed(pose, stamp_ns):
            return
        before, person.joints = person.joints, ExpectedJoints(pose, self._joint_set, stamp_ns)
        if before is not None:
            person.joints.keep_look(before)
        elif (lost := self._lost(person, stamp_ns)) is not None:
            person.continue_as(lost)
            self._first[person] = self._first.get(lost, lost)
            for tracks in (self._tracker.persons, self._tracker.lost):
                tracks[:] = [p for p in tracks if p is not lost]
        joint = np.zeros(len(pose.confidence), int)
        self._take(image, stamp_ns, (person, person.joints), [pose], joint, [person.box])

    def _lost(self, person: Person, stamp_ns: int) -> Person | None:
        """Who of those out of view a new track shows."""
        hidden = [p for p, _ in self._followed() if p.detected_ns < stamp_ns]
        return next((p for p in (*hidden, *self._tracker.lost) if found_again(p, [person], 1, stamp_ns)), None)

    def _is_followed(self, pose: BodyPose, stamp_ns: int) -> bool:
        """Whether these joints are already someone's."""
        sure = pose.confidence >= SEEN
        for _, joints in self._followed():
            if (seen := joints.seen_in(stamp_ns)) is not None:
                apart = np.linalg.norm(seen.keypoints[: len(pose.xy)] - pose.xy, axis=1)[sure]
                if np.median(np.nan_to_num(apart, nan=np.inf)) < _SAME_BODY * joints.length:
                    return True
        return False

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def tracks(self) -> dict[int, Tracks]:
        """Tracks of everybody over all images, by the numbers of ``drocap track --list``.

        Of several numbers of one person, who left and came back, the first one counts.
        """
        background, nobody = of_images(self._points), [PoseObservation(ns, 0, self._size) for ns in self._stamps]
        found: dict[int, Tracks] = {}
        for number, person in self._numbers().items():
            observations = [self._seen[person].get(empty.stamp_ns, empty) for empty in nobody]
            found[number] = replace(tracks_from_observations(observations, 1), background=background)
        return found

    def _numbers(self) -> dict[int, Person]:
        """Those with joints, by the first number of their tracks; who has none gets one after the last."""
        numbered = self.numbered()
        found: dict[Person, int] = {}
        for track, person in numbered.items():
            first = self._first.get(track, track)
            if first in self._seen:
                found.setdefault(first, person.number)
        further = sorted((person for person in self._seen if person not in found), key=lambda p: min(self._seen[p]))
        found |= {person: number for number, person in enumerate(further, len(numbered) + 1)}
        return {number: person for person, number in found.items()}


def observe_people(
    frames: Iterable[Frame],
    people: PeopleEstimator,
    on_frame: Callable[[Frame, list[PoseObservation]], None] | None = None,
    clip: Clip | None = None,
    threads: int = 2,
) -> dict[int, Tracks]:
    """Tracks of everybody in a part of the frames; with two threads or more, one decodes ahead."""
    beside, first_ns = threads > 1, None
    try:
        for frame, ahead in with_next(prefetch(frames) if beside else frames):
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            if clip is not None and not clip.holds(frame.stamp_ns - first_ns):
                people.find(frame)
                continue
            further = ahead if ahead is not None and (clip is None or clip.holds(ahead.stamp_ns - first_ns)) else None
            shown = people.process(frame, further if beside else None)
            if on_frame is not None:
                on_frame(frame, shown)
    finally:
        people.close()
    return people.tracks()


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
