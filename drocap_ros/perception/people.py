"""All persons of a recording in one pass over its images: who is where, and the joints of each."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np

from drocap_ros.background import FixedPoints, of_images
from drocap_ros.clip import Clip
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.bodies import Bodies, Body
from drocap_ros.perception.persons import PersonFinder
from drocap_ros.perception.pose.body_pose import BodyPoseModel
from drocap_ros.perception.scene import Scene, SceneStep
from drocap_ros.perception.sources.base import Frame, prefetch, with_next
from drocap_ros.perception.track_video import tracks_from_observations
from drocap_ros.perception.tracking.contested import contested
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.tracks import Tracks


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
