"""All persons of a recording, numbered: the choice of a subject by a picture."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.clip import Clip
from drocap_ros.errors import InputError
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.sources.base import Frame, prefetch
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

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


def following(config: PoseEstimatorConfig, persons: Sequence[FoundPerson], number: int) -> PoseEstimatorConfig:
    """Parameters to follow one of the persons from its first detection on."""
    person = next((person for person in persons if person.number == number), None)
    if person is None:
        there = f"{persons[0].number} to {persons[-1].number}"
        raise InputError(f"--subject {number}: expected {there}; `drocap track --list` numbers the persons of a part")
    box = ",".join(f"{value:.2f}" for value in person.boxes[person.first_ns])
    return dataclasses.replace(config, subject="box", subject_box=box, on_loss="wait")
