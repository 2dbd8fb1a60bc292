"""Single-subject tracker: keeps one person's identity through crossings and gaps."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking import doubles
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import assign_all
from drocap_ros.perception.tracking.box_filter import BoxFilter
from drocap_ros.perception.tracking.person import Person, Subject, boxes_of
from drocap_ros.perception.tracking.pose_belief import SURE_CONFIDENCE
from drocap_ros.perception.tracking.reidentification import (
    FORGET_S,
    followed_on,
    found_again,
    leaving,
)
from drocap_ros.perception.tracking.rivals import clutter_of, due_bystander, owner_of, rivals
from drocap_ros.perception.tracking.selection import SubjectChoice

#: Overlap with another person from which a predicted box counts as hidden.
_HIDDEN_IOU = 0.25
#: Overlap coefficient above which an unassigned detection is a part of a tracked person, or that person and more.
_PART = 0.75
#: Longest gap of a bystander, and the largest number of persons.
_BYSTANDER_S, _MAX_PERSONS = 2.0, 30


class SubjectTracker:
    """Tracks all persons in view, so that each detection in a crossing has its owner; one of them is the subject.

    A subject without detection is predicted for ``coast_s``.  After that there is no subject until a new track is
    re-identified: a person without simultaneous detections of the subject, of its appearance, and within reach for the
    elapsed time.
    """

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._config = config
        #: All persons in view or lately in view, the subject among them.
        self.persons: list[Person] = []
        #: The last subject, lost or not.
        self.subject: Person | None = None
        self._track_id = 0
        self.choice = SubjectChoice(config)
        self._coast_s = config.coast_s
        self._last_ns: int | None = None

    def reset(self) -> None:
        """Delete all tracks, for stamps that restarted; track ids continue."""
        self.persons, self.subject, self.choice.nothing_yet, self._last_ns = [], None, True, None

    def move_camera(self, matrix: np.ndarray) -> None:
        """Let all persons follow the image's motion (2, 3) by the camera's, those out of view as well."""
        for person in self.persons:
            person.move_camera(matrix)

    def followed(self, stamp_ns: int) -> Person | None:
        """The subject while it is in view or predicted; None while it is lost."""
        subject = self.subject
        return None if subject is None or subject.unconfirmed_s(stamp_ns) > self._coast_s else subject

    @property
    def missed(self) -> bool:
        """Whether the last image did not show the subject."""
        return self.subject is not None and self.subject.detected_ns < (self._last_ns or 0)

    def predict(self, stamp_ns: int) -> Subject | None:
        """The predicted subject; None unless the last update confirmed it."""
        subject = self.subject
        if subject is None or subject.confirmed_ns != self._last_ns:
            return None
        return Subject(self._track_id, subject.filter.box_at(stamp_ns), subject.score, False)

    def propagate(self, box: np.ndarray, stamp_ns: int) -> None:
        """Update the subject with the pose network's box (4,) px, in an image without detection."""
        subject = self.subject
        if subject is None:
            return
        for person in self.persons:
            person.filter.predict(stamp_ns)
        subject.filter.update(box)
        subject.box = np.asarray(box, float)
        subject.confirm(stamp_ns)
        self._last_ns = stamp_ns

    def confirm(self, box: np.ndarray, stamp_ns: int) -> None:
        """Confirm a predicted or low-score subject by the pose network's box (4,) px."""
        if self.subject is not None:
            self.subject.filter.update(box, noise=2.0)
            self.subject.confirm(stamp_ns)

    def judge(self, confidence: float, box: np.ndarray, stamp_ns: int) -> None:
        """Add the mean confidence of the subject's pose, found in a box (4,) px.

        A subject that has shown no person for seconds is lost from its last certain time on.
        """
        subject = self.subject
        if subject is None:
            return
        subject.pose.judge(confidence, box, stamp_ns)
        if subject.pose.refuted and subject.pose.box is not None:
            self.persons.append(clutter_of(subject, stamp_ns))
            subject.box, subject.filter = subject.pose.box, BoxFilter(subject.pose.box, subject.certain_ns)
            subject.detected_ns = subject.confirmed_ns = subject.certain_ns

    def bystander_to_judge(self, stamp_ns: int, shedding: bool = False) -> Person | None:
        """The person detected in this image whose pose should be looked at; see :func:`.rivals.due_bystander`."""
        return due_bystander(self.subject, self.persons, stamp_ns, shedding)

    def judge_bystander(
        self, person: Person, confidence: float, stamp_ns: int, same: bool = False, blurred: bool = False
    ) -> None:
        """Add a bystander's pose: mean confidence, and whether its joints are the subject's; it may be a lost one."""
        subject = self.subject
        person.pose.judge(confidence, person.box, stamp_ns, blurred)
        if subject is not None and subject.pose.believed_ns == stamp_ns and confidence >= SURE_CONFIDENCE:
            doubles.on_joints(person, subject, same)
        if self.current(stamp_ns) is None:
            self._reidentify(stamp_ns)

    def rivals(
        self, image: np.ndarray, stamp_ns: int, boxes: np.ndarray, scores: np.ndarray, confidence: float
    ) -> list[int]:
        """Indices of the detections (N, 4), (N,) that could be the subject instead, the nearest and best ones first.

        confidence : mean of the subject's pose in this image
        """
        subject = self.subject
        return [] if subject is None else rivals(subject, self.persons, image, boxes, scores, confidence, stamp_ns)

    def exchange(self, image: np.ndarray, stamp_ns: int, box: np.ndarray, score: float) -> Subject:
        """Continue the subject at a rival's box (4,) px; a track of what it was before remains."""
        subject = self.subject
        assert subject is not None
        owner = owner_of(box, self.persons, stamp_ns)
        clutter = clutter_of(subject, stamp_ns)
        clutter.double = bool(overlap_coefficient(clutter.box[None], box[None].astype(float))[0, 0] > 0.3)
        self.persons = [*(p for p in self.persons if p is subject or p is not owner), clutter]
        if subject.pose.believed_ns is None:  # what it learned was not this person's
            subject.appearance = describe(image, box)
        subject.move(box, score, stamp_ns)
        return Subject(self._track_id, subject.box, score, False)

    def update(
        self, image: np.ndarray, stamp_ns: int, boxes: np.ndarray, scores: np.ndarray, roi: np.ndarray | None = None
    ) -> Subject | None:
        """Update all tracks with one image's detections.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        stamp_ns : later than the last
        boxes : (N, 4) px; scores : (N,), at least ``low_threshold``
        roi : (4,) px, box of the drone's own tracker, or None
        """
        if roi is not None:
            self._apply_roi(np.asarray(roi, float), stamp_ns)
        if self._last_ns is not None:  # at a low image rate coasting spans at least two missed images
            self._coast_s = max(self._config.coast_s, min(2.5e-9 * (stamp_ns - self._last_ns), FORGET_S))
        self._last_ns = stamp_ns
        for person in self.persons:
            person.filter.predict(stamp_ns)
        appearances = [describe(image, box) for box in boxes]
        subject = self.followed(stamp_ns)
        others = followed_on(self.subject, self.persons, self._coast_s, stamp_ns)
        assigned, replacements = assign_all(
            subject, others, boxes, scores, appearances, stamp_ns, self._config.detection_threshold
        )
        self.persons += replacements
        doubles.on_detections(self.persons, subject, stamp_ns)
        self._spawn(boxes, scores, appearances, assigned, stamp_ns)
        self._reidentify(stamp_ns)
        self._choose(image.shape, stamp_ns)
        self._prune(image.shape, stamp_ns)
        self.choice.nothing_yet &= not len(boxes)
        return self.current(stamp_ns)

    def _spawn(
        self,
        boxes: np.ndarray,
        scores: np.ndarray,
        appearances: list[np.ndarray | None],
        assigned: set[int],
        stamp_ns: int,
    ) -> None:
        """Start tracks from unassigned detections, except parts of tracked persons."""
        subject = self.subject
        # Leaves and signs that were found to be no person may cover one.
        known = boxes_of(p for p in self.persons if p.detected_ns == stamp_ns and p.plausible)
        if subject is not None and not subject.left_image and 0.0 < subject.unconfirmed_s(stamp_ns) <= self._coast_s:
            known = np.concatenate([known, subject.filter.box()[None]])
        for j in range(len(boxes)):
            if j in assigned or scores[j] < self._config.detection_threshold:
                continue
            if len(known) and overlap_coefficient(boxes[j][None].astype(float), known).max() > _PART:
                continue
            person = Person(boxes[j], float(scores[j]), stamp_ns, appearances[j])
            doubles.compare(person, subject, appearances[j])
            self.persons.append(person)

    def _reidentify(self, stamp_ns: int) -> None:
        """Re-identify a lost subject in a new track."""
        lost = self.subject
        if lost is None or lost.unconfirmed_s(stamp_ns) <= 0:
            return
        if person := found_again(lost, self.persons, self._config.confirm_frames, stamp_ns):
            self.persons.remove(lost)
            person.appearance = lost.appearance if lost.appearance is not None else person.appearance
            self.subject, person.left_image = person, False

    def _apply_roi(self, roi: np.ndarray, stamp_ns: int) -> None:
        """A roi away from the subject is a choice; one on the subject replaces missing detections."""
        subject = self.subject
        if subject is None or iou(roi[None], subject.filter.box()[None])[0, 0] < 0.1:
            self.choice.box = roi
        elif self._config.subject == "roi" and subject.unconfirmed_s(stamp_ns) > 0.5 * self._coast_s:
            subject.update(roi, 0.0, stamp_ns)
            subject.confirm(stamp_ns)

    def _choose(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """Make a person the subject: the one in a given box, then one by the rule."""
        given = self.choice.given(self.persons, stamp_ns)
        if given is not None and given not in self.persons:
            self.persons.append(given)
        if given is not None and given is not self.subject:
            given.pose.choose(given.box, stamp_ns)
            self._follow(given)
        first = not self._track_id
        best = self.choice.by_rule(self.persons, self.subject, shape, stamp_ns, self._coast_s, first)
        if best is not None:
            self._follow(best)

    def _follow(self, person: Person) -> None:
        self.subject = person
        self._track_id, person.left_image = self._track_id + 1, False
        for bystander in self.persons:  # others than the last subject may be this one
            bystander.pose.other = False

    def _prune(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """Delete the tracks of bystanders out of view."""
        subject = self.subject
        if subject is not None:
            subject.left_image = subject.undetected_s(stamp_ns) > 0 and (subject.left_image or leaving(subject, shape))
        kept = [p for p in self.persons if p is subject or p.undetected_s(stamp_ns) <= _BYSTANDER_S]
        if len(kept) > _MAX_PERSONS:
            kept.sort(key=lambda p: (p is not subject, -p.detected_ns))
        self.persons = kept[:_MAX_PERSONS]

    def current(self, stamp_ns: int) -> Subject | None:
        """The subject in the image of the last update."""
        subject = self.subject
        if subject is None or subject.unconfirmed_s(stamp_ns) > (0.0 if subject.left_image else self._coast_s):
            return None
        if subject.detected_ns == stamp_ns:
            return Subject(self._track_id, subject.box, subject.score, False)
        box = subject.filter.box()
        persons = [p for p in self.persons if p is not subject and p.plausible and not p.double]
        others = boxes_of(p for p in persons if p.confirmed_ns == stamp_ns)
        hidden = bool((iou(box[None], others) > _HIDDEN_IOU).any())
        return Subject(self._track_id, box, 0.0, hidden)
