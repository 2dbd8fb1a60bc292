"""All persons of a recording: numbered for the choice of a subject, and the joints of each in one pass."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FixedPoints, of_images
from drocap_ros.clip import Clip
from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.bodies import Bodies, Body
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.pose.body_pose import BodyPoseModel
from drocap_ros.perception.scene import Scene, SceneStep
from drocap_ros.perception.sources.base import Frame, prefetch, with_next
from drocap_ros.perception.track_video import tracks_from_observations
from drocap_ros.perception.tracking.own_joints import contested
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.tracks import Tracks

_EVERY_NS = 200_000_000  # interval of the detections: a walking person moves by a fifth of the length
_JITTER_NS = 5_000_000  # by which an image may come earlier
_LEAST_SCORE = 0.45  # least recent mean score of a person; clutter and parts of bodies lie below


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


class PersonFinder:
    """Finds the persons of a recording by five detections a second, and numbers them at the end.

    A person that leaves the image and returns later counts as another one.
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig) -> None:
        # Without a box of the drone the rule `roi` never chooses a subject: all persons are bystanders.
        self.estimator = PoseEstimator(models_dir, dataclasses.replace(config, subject="roi", subject_box=""))
        self._least = config.confirm_frames
        self._last_ns: int | None = None
        self._seen: dict[Person, dict[int, np.ndarray]] = {}
        self._images = 0

    def due(self, stamp_ns: int) -> bool:
        """Whether the image of this time is one in which persons are sought."""
        last_ns = self._last_ns
        return last_ns is None or stamp_ns < last_ns or stamp_ns - last_ns >= _EVERY_NS - _JITTER_NS

    def find(self, image: np.ndarray, stamp_ns: int) -> list[Person]:
        """Those detected in the next image that is due, (H, W, 3) uint8 BGR."""
        self._last_ns = stamp_ns
        self.estimator.process(image, stamp_ns)
        self._images += 1
        # A track that clutter has taken over is a person's up to there.
        found = [p for p in self.estimator.tracker.detected(stamp_ns) if p.mean_score >= _LEAST_SCORE]
        for person in found:
            self._seen.setdefault(person, {})[stamp_ns] = person.box
        return found

    def numbered(self) -> dict[Person, FoundPerson]:
        """The persons in the order of their appearance, then from left to right."""
        least = min(self._least, self._images)
        found = [(person, boxes) for person, boxes in self._seen.items() if len(boxes) >= least]
        if not found:
            raise InputError(
                f"expected a person in view, found none in {self._images} images; try another video or model"
            )
        found.sort(key=lambda entry: (min(entry[1]), float(entry[1][min(entry[1])][0])))
        return {person: FoundPerson(number, boxes) for number, (person, boxes) in enumerate(found, 1)}


def find_persons(
    frames: Iterable[Frame],
    models_dir: str | Path,
    config: PoseEstimatorConfig,
    on_frame: Callable[[Frame, None], None] | None = None,
) -> list[FoundPerson]:
    """Persons of a recording, as :class:`PersonFinder` finds them."""
    finder = PersonFinder(models_dir, config)
    for frame in prefetch(frames):
        if on_frame is not None:
            on_frame(frame, None)
        if finder.due(frame.stamp_ns):
            finder.find(frame.image, frame.stamp_ns)
    return list(finder.numbered().values())


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

    threads : that share the work on an image; the results are the same with any number
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig, threads: int = 2) -> None:
        self._finder = PersonFinder(models_dir, config)
        estimator = self._finder.estimator
        self._bodies = Bodies(BodyPoseModel(estimator.pose_model), estimator.feet, config, threads=threads)
        self._scene = Scene()
        #: The scene in the next image, which another thread follows.
        self._ahead: Future[SceneStep] | None = None
        #: Boxes of all persons after each of the last two images.
        self._boxes: deque[list[np.ndarray]] = deque([[], []], maxlen=2)
        #: Of each person the observations of the images that show its joints, by stamp, and detections that show it.
        self._seen: dict[Body, dict[int, PoseObservation]] = {}
        self._found: dict[Body, Counter[Person]] = {}
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
            self._ahead = self._bodies.pool.submit(self._scene.step, ahead.image, ahead.stamp_ns, self._boxes[1])
        bodies = self._bodies
        bodies.predict(stamp_ns, scene.motion)
        detected = self._finder.find(image, stamp_ns) if self._finder.due(stamp_ns) else []
        for person, body in bodies.observe(image, stamp_ns, detected):
            self._found.setdefault(body, Counter())[person] += 1
        self._boxes.append([*(one.track.box for one in bodies.people), *(person.box.copy() for person in detected)])
        self._stamps.append(stamp_ns)
        self._points.append(scene.points)
        for one in (*bodies.people, *bodies.gone):
            if one.seen is not None and one.shown(stamp_ns):
                self._seen.setdefault(one, {})[stamp_ns] = one.seen
        shown = [one.seen for one in bodies.people if one.seen is not None and one.shown(stamp_ns)]
        return [replace(seen, track_id=i, background=scene.points) for i, seen in enumerate(shown, 1)]

    def count(self, frame: Frame) -> None:
        """Find the persons of an image outside of the part that is asked for: their numbers count there, too."""
        if self._finder.due(frame.stamp_ns):
            self._finder.find(frame.image, frame.stamp_ns)

    def close(self) -> None:
        """End the threads."""
        self._bodies.pool.shutdown()

    def tracks(self) -> dict[int, Tracks]:
        """Tracks of everybody over all images, by the numbers of ``drocap track --list``.

        Of several numbers of one person, who left and came back, the first one counts.
        """
        background, nobody = of_images(self._points), [PoseObservation(ns, 0, self._size) for ns in self._stamps]
        found: dict[int, Tracks] = {}
        lengths = []
        for number, one in self._numbered().items():
            observations = [self._seen[one].get(empty.stamp_ns, empty) for empty in nobody]
            found[number] = replace(tracks_from_observations(observations, 1), background=background)
            boxes = np.array([observation.roi for observation in observations], float)
            length = (boxes[:, 2:] - boxes[:, :2]).max(axis=1)
            lengths.append(np.where(np.isnan(length), np.nanmedian(length), length))
        stamps = np.array(self._stamps, np.int64)
        others = contested([tracks.keypoints for tracks in found.values()], stamps, lengths)
        return {n: _without(tracks, joints) for (n, tracks), joints in zip(found.items(), others, strict=True)}

    def _numbered(self) -> dict[int, Body]:
        """Those whom detections have found, by the first of their numbers; who has none gets one after the last."""
        found: dict[int, Body] = {}
        everybody = [one for one in (*self._bodies.people, *self._bodies.gone) if one in self._seen]
        counts = {one: self._found.get(one, Counter()) for one in everybody}
        for person, numbered in self._finder.numbered().items():
            best = max(everybody, key=lambda one: counts[one][person], default=None)
            if best is not None and counts[best][person] and best not in found.values():
                found[numbered.number] = best
        further = [one for one in everybody if one not in found.values() and len(counts[one])]
        last = max(person.number for person in self._finder.numbered().values())
        return found | dict(enumerate(sorted(further, key=lambda one: min(self._seen[one])), last + 1))


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
