"""Live: persons beside the subject, whom another estimator follows, each in a place of its own."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from drocap_ros.observation import PoseObservation
from drocap_ros.perception.bodies import Bodies, Body
from drocap_ros.perception.persons import PersonSearch
from drocap_ros.perception.pose.body_pose import BodyPoseModel
from drocap_ros.perception.scene import Scene
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.skeleton import BODY_15

_LEAST_JOINTS = 4  # of BODY_15 by which the subject is known among others, as of a person
_LEAST_HITS = 2  # detections of someone who is given a place: clutter rarely has two

log = logging.getLogger(__name__)


class Companions:
    """Follows ``people - 1`` persons beside the subject; equal images and subjects give equal results.

    The subject has the first place.  Whoever comes takes the first free one of the others, the largest first, and
    frees it by leaving the image or after two seconds out of view.  Who returns soon is known again by look and place.
    Nobody's joints are the subject's.  Memory is bounded.

    Parameters
    ----------
    models_dir, config : as of :class:`~drocap_ros.perception.estimator.PoseEstimator`
    ids : of the persons, each taken once
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig, ids: Iterator[int]) -> None:
        self._config, self._ids = config, ids
        self._search = PersonSearch(models_dir, config)
        self._places: dict[int, Body | None] = dict.fromkeys(range(2, config.people + 1))
        self._last_ns = 0
        self._bodies = self._nobody()
        self._restart()

    def _nobody(self) -> Bodies:
        estimator = self._search.estimator
        model = BodyPoseModel(estimator.pose_model)
        return Bodies(model, estimator.feet, self._config, most=len(self._places), threads=1)

    def _restart(self) -> None:
        self.close()
        self._bodies = self._nobody()
        self._scene = Scene()
        self._subject_id = 0
        self._numbers: dict[Body, int] = {}
        #: Boxes of all persons after each of the last two images.
        self._boxes: deque[list[np.ndarray]] = deque([[], []], maxlen=2)

    def process(self, image: np.ndarray, subject: PoseObservation) -> dict[int, PoseObservation]:
        """Who is in each place in the next image; a person whom it does not show has a box and no keypoints.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        subject : of the same image and stamp; an earlier stamp than the last one's begins a new stream
        """
        stamp_ns = subject.stamp_ns
        if stamp_ns < self._last_ns:
            log.warning("stamps went back by %.3f s: other persons are forgotten", (self._last_ns - stamp_ns) * 1e-9)
            self._restart()
        self._last_ns = stamp_ns
        scene = self._scene.step(image, stamp_ns, self._boxes[0])
        self._bodies.predict(stamp_ns, scene.motion)
        given = subject if np.isfinite(subject.keypoints[: len(BODY_15)]).all(axis=1).sum() >= _LEAST_JOINTS else None
        another = given is not None and subject.track_id != self._subject_id
        self._subject_id = subject.track_id if another else self._subject_id
        self._bodies.give(image, given, another=another)
        detected = self._search.find(image, stamp_ns) if self._search.due(stamp_ns) else []
        detected = sorted(detected, key=lambda person: -person.usual_length)
        self._bodies.observe(image, stamp_ns, [person for person in detected if person.hits >= _LEAST_HITS])
        self._bodies.forget(stamp_ns)
        self._boxes.append([one.track.box for one in self._bodies.people] + [person.box.copy() for person in detected])
        self._assign()
        return {place: self._shown(one, subject) for place, one in self._places.items()}

    @property
    def followed(self) -> list[int]:
        """Ids of those who have a place, in view or hidden for a moment."""
        return [self._numbers[one] for one in self._places.values() if one is not None]

    def _assign(self) -> None:
        """Free the places of those who left, and give free ones to those who came."""
        bodies = self._bodies
        others = [one for one in bodies.people if one is not bodies.subject]
        placed = [one for one in self._places.values() if one in others]
        free = [one for one in others if one not in placed]
        for place, one in self._places.items():
            if one not in placed:
                self._places[place] = free.pop(0) if free else None
        for one in others:
            if one not in self._numbers:
                self._numbers[one] = next(self._ids)
        self._numbers = {one: self._numbers[one] for one in self._numbers if one in others or one in bodies.gone}

    def _shown(self, one: Body | None, subject: PoseObservation) -> PoseObservation:
        if one is None or one.seen is None:
            return PoseObservation(subject.stamp_ns, 0, subject.image_size)
        seen = replace(one.seen, stamp_ns=subject.stamp_ns, track_id=self._numbers[one])
        if one.shown(subject.stamp_ns):
            return seen
        blank = {name: np.full_like(getattr(seen, name), np.nan) for name in ("keypoints", "covariance")}
        box, confidence = one.track.box.astype(np.float32), np.zeros_like(seen.confidence)
        return replace(seen, roi=box, detection_score=0.0, confidence=confidence, space=None, **blank)

    def close(self) -> None:
        """End the threads."""
        self._bodies.pool.shutdown()
