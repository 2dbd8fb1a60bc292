"""All persons of a recording in one pass over its images: who is where, and the joints of each."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FixedPoints, of_images
from drocap_ros.clip import Clip
from drocap_ros.observation import PoseObservation
from drocap_ros.perception.detection.nms import overlap_coefficient
from drocap_ros.perception.persons import PersonFinder
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, BodyPose, BodyPoseModel
from drocap_ros.perception.scene import Scene, SceneStep
from drocap_ros.perception.sources.base import Frame, prefetch, with_next
from drocap_ros.perception.track_video import tracks_from_observations
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.body_track import BodyTrack
from drocap_ros.perception.tracking.contested import contested
from drocap_ros.perception.tracking.identity import found_again
from drocap_ros.perception.tracking.limb_colours import limb_colours
from drocap_ros.perception.tracking.own_joints import Poses, own_joints
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, EMPTY_CONFIDENCE, Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15, BODY_19
from drocap_ros.tracks import Tracks

_HIDDEN_S = 2.0  # time without own joints after which a person is sought elsewhere, too
_UNDETECTED_S = 3.0  # time without a detection over which doubtful poses are a person's
_OVERLAP = 0.02  # overlap coefficient of two boxes from which joints may be the other's
_LEAST_BESIDE = 0.6  # confidence of a joint in another's box, too: of the own ones 5 % have less, of others' the half
_LEAST_JOINTS = 4  # of BODY_15 that show a person


@dataclass(eq=False)
class _Followed:
    """A person who is followed, and the observations of the images in which its joints were seen, by stamp."""

    track: BodyTrack
    seen: dict[int, PoseObservation] = field(default_factory=dict)
    found: Counter[Person] = field(default_factory=Counter)


class PeopleEstimator:
    """Follows all persons through the images of one camera; equal images give equal results.

    threads : that share the work on an image; the results are the same with any number
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig, threads: int = 2) -> None:
        self._config, self._finder = config, PersonFinder(models_dir, config)
        self._model = BodyPoseModel(self._finder.estimator.pose_model)
        self._feet = self._finder.estimator.feet
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="people")
        self._scene = Scene()
        #: The scene in the next image, which another thread follows.
        self._ahead: Future[SceneStep] | None = None
        #: Boxes of all persons after each of the last two images.
        self._boxes: deque[list[np.ndarray]] = deque([[], []], maxlen=2)
        self._people: list[_Followed] = []
        self._gone: list[_Followed] = []
        self._stamps: list[int] = []
        self._points: list[FixedPoints | None] = []
        self._size = (0, 0)

    def process(self, frame: Frame, ahead: Frame | None = None) -> list[PoseObservation]:
        """The persons whose joints an image shows; ``track_id`` counts them up.

        ahead : the next image, the one of the next call
        """
        image, stamp_ns = frame.image, frame.stamp_ns
        self._size = (image.shape[1], image.shape[0])
        scene = self._scene.step(image, stamp_ns, self._boxes[0]) if self._ahead is None else self._ahead.result()
        self._ahead = None
        if ahead is not None:
            self._ahead = self._pool.submit(self._scene.step, ahead.image, ahead.stamp_ns, self._boxes[1])
        for one in self._people:
            if scene.motion is not None:
                one.track.move_camera(scene.motion)
            one.track.predict(stamp_ns)
        detected = self._finder.find(image, stamp_ns) if self._finder.due(stamp_ns) else []
        self._observe(image, stamp_ns, detected)
        self._lose(stamp_ns)
        self._boxes.append([*(one.track.box for one in self._people), *(person.box.copy() for person in detected)])
        self._stamps.append(stamp_ns)
        self._points.append(scene.points)
        shown = [one.seen[stamp_ns] for one in self._people if stamp_ns in one.seen]
        return [replace(seen, track_id=i, background=scene.points) for i, seen in enumerate(shown, 1)]

    def count(self, frame: Frame) -> None:
        """Find the persons of an image outside of the part that is asked for: their numbers count there, too."""
        if self._finder.due(frame.stamp_ns):
            self._finder.find(frame.image, frame.stamp_ns)

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _observe(self, image: np.ndarray, stamp_ns: int, detected: list[Person]) -> None:
        """The joints of everybody in the image, and new persons."""
        boxes = [one.track.box for one in self._people]
        poses = list(self._pool.map(lambda box: self._model.estimate(image, box), boxes))
        for group in _groups(boxes):
            self._share(image, stamp_ns, [self._people[i] for i in group], [poses[i] for i in group])
        for person in detected:
            shown = [one for one in self._people if stamp_ns in one.seen and one.track.on(person.box)]
            best = max(shown, key=lambda one: one.track.overlap(person.box), default=None)
            best = best or self._begin(image, stamp_ns, person)
            if best is not None:
                best.found[person] += 1
                best.track.detected_ns = stamp_ns

    def _share(self, image: np.ndarray, stamp_ns: int, group: list[_Followed], poses: list[BodyPose]) -> None:
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
                self._take(image, stamp_ns, one, poses, joint[k], others)

    def _colours(self, image: np.ndarray, one: _Followed, xy: np.ndarray) -> np.ndarray:
        return limb_colours(image, xy, self._model.joint_map.joints, one.track.length)

    def _take(
        self,
        image: np.ndarray,
        stamp_ns: int,
        one: _Followed,
        poses: list[BodyPose],
        joint: np.ndarray,
        others: list[np.ndarray],
    ) -> None:
        """Take over the joints (P,) of poses that are a person's, beside others in boxes (4,) px."""
        track, at = one.track, np.arange(len(joint))
        given = np.maximum(joint, 0)
        xy, covariance, confidence = (
            np.array([getattr(pose, name) for pose in poses])[given, at] for name in ("xy", "covariance", "confidence")
        )
        inside = ((xy >= 0) & (xy < np.array(self._size))).all(axis=1)
        free = np.ones(len(xy), bool)
        for other in others:
            free &= ((xy < other[:2]) | (xy > other[2:])).any(axis=1)
        least = np.where(free, self._config.keypoint_threshold, _LEAST_BESIDE)
        own = (joint >= 0) & inside & (confidence >= least)
        believed = float(np.where(own, confidence, 0.0)[: len(BODY_15)].mean())
        recent = (stamp_ns - track.detected_ns) * 1e-9 <= _UNDETECTED_S
        needed = 0.0 if recent and others else EMPTY_CONFIDENCE if recent else CLEAR_CONFIDENCE
        sure = own & (confidence >= EMPTY_CONFIDENCE)
        if believed < needed or sure[: len(BODY_15)].sum() < _LEAST_JOINTS:
            return
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
        one.seen[stamp_ns] = self._observation(
            image, stamp_ns, one, BodyPose(xy, covariance, confidence * own, poses[0].network)
        )

    def _observation(self, image: np.ndarray, stamp_ns: int, one: _Followed, pose: BodyPose) -> PoseObservation:
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

    def _begin(self, image: np.ndarray, stamp_ns: int, found: Person) -> _Followed | None:
        """Whom a detection shows that is nobody's who is in view: one who was hidden or gone, or someone new."""
        pose = self._model.estimate(image, found.box)
        if pose.belief(image, found.box) < CONFIRM_CONFIDENCE or self._is_followed(pose, stamp_ns):
            return None
        person = Person(found.box, found.score, stamp_ns, describe(image, found.box))
        person.hits = found.hits
        person.pose.judge(pose.mean_confidence, found.box, stamp_ns)
        one = _Followed(BodyTrack(person, pose, self._model.joint_map.joints, stamp_ns))
        again = self._again(one, stamp_ns)
        if again is None:
            self._people.append(one)
        else:
            again.track.continue_as(one.track)
            one = again
        self._take(image, stamp_ns, one, [pose], np.zeros((len(pose.confidence)), int), [found.box])
        return one

    def _again(self, one: _Followed, stamp_ns: int) -> _Followed | None:
        """Who of those out of view a new track shows."""
        hidden = [other for other in self._people if stamp_ns not in other.seen]
        here = [other for other in hidden if other.track.on(one.track.person.box)]
        if here:
            return max(here, key=lambda other: other.track.person.similarity(one.track.person.appearance))
        for lost in (*hidden, *self._gone):
            if found_again(lost.track.person, [one.track.person], 1, stamp_ns):
                if lost in self._gone:
                    self._gone.remove(lost)
                    self._people.append(lost)
                return lost
        return None

    def _is_followed(self, pose: BodyPose, stamp_ns: int) -> bool:
        """Whether these joints are already someone's."""
        seen = pose.confidence >= EMPTY_CONFIDENCE
        for one in self._people:
            if stamp_ns in one.seen:
                apart = np.linalg.norm(one.seen[stamp_ns].keypoints[: len(pose.xy)] - pose.xy, axis=1)[seen]
                if np.median(np.nan_to_num(apart, nan=np.inf)) < 0.1 * one.track.length:
                    return True
        return False

    def _lose(self, stamp_ns: int) -> None:
        """Give up who has not been seen for long, or has left the image; who is in view together is not the same."""
        shown = [one.track.person for one in self._people if stamp_ns in one.seen]
        for person in shown:
            person.others.update(p for p in shown if p is not person)
        image = np.array([[0.0, 0.0, *self._size]])
        for one in list(self._people):
            hidden_s = (stamp_ns - one.track.seen_ns) * 1e-9
            outside = overlap_coefficient(one.track.box[None], image)[0, 0] < 0.3
            if hidden_s > _HIDDEN_S or (outside and hidden_s > 0):
                self._people.remove(one)
                self._gone.append(one)

    def tracks(self) -> dict[int, Tracks]:
        """Tracks of everybody over all images, by the numbers of ``drocap track --list``.

        Of several numbers of one person, who left and came back, the first one counts.

        Raises
        ------
        InputError
            When no person is found.
        """
        background, nobody = of_images(self._points), [PoseObservation(ns, 0, self._size) for ns in self._stamps]
        found: dict[int, Tracks] = {}
        lengths = []
        for number, one in self._numbered().items():
            observations = [one.seen.get(empty.stamp_ns, empty) for empty in nobody]
            found[number] = replace(tracks_from_observations(observations, 1), background=background)
            boxes = np.array([observation.roi for observation in observations], float)
            length = (boxes[:, 2:] - boxes[:, :2]).max(axis=1)
            lengths.append(np.where(np.isnan(length), np.nanmedian(length), length))
        stamps = np.array(self._stamps, np.int64)
        others = contested([tracks.keypoints for tracks in found.values()], stamps, lengths)
        return {n: _without(tracks, joints) for (n, tracks), joints in zip(found.items(), others, strict=True)}

    def _numbered(self) -> dict[int, _Followed]:
        """Those whom detections have found, by the first of their numbers; who has none gets one after the last."""
        found: dict[int, _Followed] = {}
        everybody = [one for one in (*self._people, *self._gone) if one.seen]
        for person, numbered in self._finder.numbered().items():
            best = max(everybody, key=lambda one: one.found[person], default=None)
            if best is not None and best.found[person] and best not in found.values():
                found[numbered.number] = best
        further = [one for one in everybody if one not in found.values() and len(one.found)]
        last = max(person.number for person in self._finder.numbered().values())
        return found | dict(enumerate(sorted(further, key=lambda one: min(one.seen)), last + 1))


def _without(tracks: Tracks, joints: np.ndarray) -> Tracks:
    """Tracks without the joints (F, P) bool."""
    assert tracks.confidence is not None
    assert tracks.covariance is not None
    blank = np.where(joints, np.nan, 1.0)[..., None]
    return replace(
        tracks,
        keypoints=tracks.keypoints * blank,
        covariance=tracks.covariance * blank,
        confidence=np.where(joints, 0.0, tracks.confidence),
    )


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
                people.count(frame)
                continue
            further = ahead if ahead is not None and (clip is None or clip.holds(ahead.stamp_ns - first_ns)) else None
            shown = people.process(frame, further if beside else None)
            if on_frame is not None:
                on_frame(frame, shown)
    finally:
        people.close()
    return people.tracks()
