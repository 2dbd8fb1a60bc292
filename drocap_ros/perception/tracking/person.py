"""Track of one person, the subject or a bystander, and the subject in one image."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.tracking.appearance import similarity
from drocap_ros.perception.tracking.box_filter import BoxFilter
from drocap_ros.perception.tracking.camera_motion import moved_box
from drocap_ros.perception.tracking.pose_belief import PoseBelief

#: Weight of a new descriptor in the mean appearance.
_APPEARANCE_RATE = 0.08
#: Number of descriptors in a settled mean appearance.
_SETTLED = 10
#: Speed with which a person may deviate from the predicted motion, lengths/s: who falls gains 3 in half a second.
_SPEED = 1.5
#: Weight of a new detection score in the mean score.
_SCORE_RATE = 0.3
#: Least mean score of a reliable track; body parts and clutter score below.
_RELIABLE_SCORE = 0.4


@dataclass(frozen=True)
class Subject:
    """The subject in one image.

    track_id : 1, 2, ...
    box : (4,) x_min y_min x_max y_max px, detected, or predicted while ``score`` is 0
    score : the detector's score; 0 = predicted
    hidden : predicted at another person's place; keypoints found there would be that person's
    """

    track_id: int
    box: np.ndarray
    score: float
    hidden: bool


class Person:
    """Box filter, appearance and history of one person.

    first_ns : first detection; detected_ns : last detection; confirmed_ns : last confirmed detection
    score : of the last detection; mean_score : recent mean, low for body parts and clutter
    hits : number of detections
    began_at_subject, double : whether its first box lay on the subject's, and whether it is a second box around the
        subject; see ``doubles.py``
    left_image : whether it left at an edge of the image; set for the subject only
    pose : what its poses say about it
    """

    def __init__(self, box: np.ndarray, score: float, stamp_ns: int, appearance: np.ndarray | None) -> None:
        self.filter = BoxFilter(box, stamp_ns)
        self.box = np.asarray(box, float)
        self.first_ns = stamp_ns
        self.detected_ns = stamp_ns
        self.confirmed_ns = stamp_ns
        self.score = score
        self.mean_score = score
        self.hits = 1
        self.began_at_subject = self.double = self.left_image = False
        self.pose = PoseBelief(stamp_ns)
        self.appearance = appearance
        self._descriptors = 1 if appearance is not None else 0

    def undetected_s(self, stamp_ns: int) -> float:
        """Seconds since the last detection."""
        return (stamp_ns - self.detected_ns) * 1e-9

    def unconfirmed_s(self, stamp_ns: int) -> float:
        """Seconds since the last confirmed detection."""
        return (stamp_ns - self.confirmed_ns) * 1e-9

    @property
    def certain_ns(self) -> int:
        """Last time at which it was certainly this person: by its pose, without poses by its detection."""
        return self.confirmed_ns if self.pose.believed_ns is None else min(self.pose.believed_ns, self.confirmed_ns)

    @property
    def plausible(self) -> bool:
        """Whether its poses leave it to be a person."""
        return self.pose.plausible_ns is not None

    @property
    def reliable(self) -> bool:
        """Whether the scores and the poses of a bystander let it be compared with the subject."""
        return self.plausible and self.mean_score >= _RELIABLE_SCORE

    def sought_box(self, stamp_ns: int) -> np.ndarray:
        """(4,) px around the place where the whole person may be after a gap: the last box showed a part, curled up."""
        box = self.filter.box_at(stamp_ns)
        reach = max(self.filter.length, self.pose.length) * (0.5 + _SPEED * self.undetected_s(stamp_ns))
        centre = (box[:2] + box[2:]) / 2
        return np.concatenate([np.minimum(box[:2], centre - reach), np.maximum(box[2:], centre + reach)])

    def update(self, box: np.ndarray, score: float, stamp_ns: int) -> None:
        """Update with a detection, not yet confirmed."""
        self.filter.update(box)
        self.box = np.asarray(box, float)
        self.detected_ns = stamp_ns
        self.score = score
        self.mean_score += _SCORE_RATE * (score - self.mean_score)
        self.hits += 1

    def move(self, box: np.ndarray, score: float, stamp_ns: int) -> None:
        """Continue at another box (4,) px: the last ones were not this person's."""
        self.filter = BoxFilter(box, stamp_ns)
        self.box = np.asarray(box, float)
        self.score = self.mean_score = score
        self.confirm(stamp_ns)

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        self.filter.move_camera(matrix)
        self.box = moved_box(matrix, self.box)
        if self.pose.box is not None:
            self.pose.box = moved_box(matrix, self.pose.box)

    def confirm(self, stamp_ns: int) -> None:
        """Confirm the detection at this time."""
        self.detected_ns = self.confirmed_ns = stamp_ns

    def update_appearance(self, appearance: np.ndarray | None) -> None:
        """Blend a descriptor into the mean appearance, with larger weights at first."""
        if appearance is None:
            return
        self._descriptors += 1
        if self.appearance is None:
            self.appearance = appearance
            return
        rate = max(_APPEARANCE_RATE, 1 / self._descriptors) if self._descriptors < _SETTLED else _APPEARANCE_RATE
        # The squares are the histograms; a blend of these keeps their sum.
        self.appearance = np.sqrt((1 - rate) * self.appearance**2 + rate * appearance**2)

    @property
    def appearance_settled(self) -> bool:
        """Whether the appearance is a mean over enough images."""
        return self._descriptors >= _SETTLED

    def similarity(self, appearance: np.ndarray | None) -> float:
        """Similarity to a descriptor in [0, 1]."""
        return similarity(self.appearance, appearance)


def boxes_of(persons: Iterable[Person]) -> np.ndarray:
    """(N, 4) px, last boxes."""
    return np.array([p.box for p in persons]).reshape(-1, 4)
