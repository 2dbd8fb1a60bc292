"""Single-subject tracker: keeps one person's identity through crossings and gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.detection.nms import iou, overlap_coefficient
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig, parse_box
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import assign
from drocap_ros.perception.tracking.detection_windows import Window, WindowSchedule, tight_window, wide_window
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.reidentification import (
    FORGET_S,
    MIXED_IOU,
    RELIABLE_SCORE,
    is_double,
    known_other,
    leaving,
    replaced,
    same_person,
)

#: Overlap with another person from which a predicted box counts as hidden.
_HIDDEN_IOU = 0.25
#: Least overlap of a detection with the predicted box that needs no second pass.
_CLEAR_IOU = 0.5
#: Overlap coefficient above which an unassigned detection is a part of a tracked person, or that person and more.
_PART = 0.75
#: Free margin around an isolated subject, lengths.
_ISOLATED = 0.4
#: Longest gap of a person that the search without a subject centres on.
_CANDIDATE_S = 0.3
#: For ``on_loss = next``: time beyond coasting after which a subject lost inside the image is given up.
_GIVE_UP_S = 3.0
#: Longest gap of a bystander, and the largest number of persons.
_BYSTANDER_S, _MAX_PERSONS = 2.0, 30
#: Score from which the first person ever needs no confirmation by further images.
_CERTAIN_SCORE = 0.6


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
        self._subject: Person | None = None
        self._track_id = 0
        self._left_image = False
        self._chosen_box: np.ndarray | None = parse_box(config.subject_box) if config.subject == "box" else None
        self._schedule = WindowSchedule()
        self._any_detected = False
        self._coast_s = config.coast_s
        self._last_ns: int | None = None

    def reset(self) -> None:
        """Delete all tracks, for stamps that restarted; track ids continue."""
        self.persons, self._subject, self._any_detected, self._last_ns = [], None, False, None
        self._schedule.reset()

    def windows(
        self, image_size: tuple[int, int], stamp_ns: int, single: bool = False, close: bool = False
    ) -> list[Window | None]:
        """Windows of the next image for the detector; None = the whole image.

        ``single`` allows one window; ``close`` takes a smaller one around the subject.
        """
        if self._chosen_box is not None:
            near = wide_window(self._chosen_box, image_size)
            return [near] if single else list({near: None, None: None})
        subject = self._subject
        if subject is not None and subject.unconfirmed_s(stamp_ns) <= self._coast_s:
            return self._schedule.near_subject(subject.filter.box_at(stamp_ns), image_size, stamp_ns, single, close)
        return self._schedule.search(self._candidate_box(stamp_ns), image_size, stamp_ns, single)

    def _candidate_box(self, stamp_ns: int) -> np.ndarray | None:
        """(4,) px, a possible new subject: a small person needs a window to be confirmed."""
        lost = self._subject
        recent = [p for p in self.persons if p is not lost and p.undetected_s(stamp_ns) <= _CANDIDATE_S]
        if lost is not None:  # persons in view together with the subject cannot be the subject
            recent = [p for p in recent if p.first_ns > lost.confirmed_ns]
        if not recent:
            return None
        best = max(recent, key=lambda p: (p.hits < self._config.confirm_frames, p.mean_score))
        return best.filter.box_at(stamp_ns)

    def second_pass_window(
        self, image_size: tuple[int, int], stamp_ns: int, boxes: np.ndarray, scores: np.ndarray
    ) -> Window | None:
        """Tight window around a subject that the detections (N, 4), (N,) do not show clearly, or None."""
        subject = self._subject
        if subject is None or self._chosen_box is not None or subject.unconfirmed_s(stamp_ns) > self._coast_s:
            return None
        box = subject.filter.box_at(stamp_ns)
        clear = scores >= self._config.detection_threshold
        if clear.any() and iou(box[None], boxes[clear].astype(float)).max() > _CLEAR_IOU:
            return None
        return tight_window(box, image_size)

    def predict(self, stamp_ns: int) -> Subject | None:
        """The predicted subject; None unless the last update confirmed it."""
        subject = self._subject
        if subject is None or self._chosen_box is not None or subject.confirmed_ns != self._last_ns:
            return None
        return Subject(self._track_id, subject.filter.box_at(stamp_ns), subject.score, False)

    def isolated(self, predicted: Subject, image_size: tuple[int, int], stamp_ns: int) -> bool:
        """Whether the predicted subject is away from others and from the image's edges, and no full image is due."""
        subject, box = self._subject, predicted.box
        if subject is None or self._schedule.full_image_due(stamp_ns):
            return False
        around = box + _ISOLATED * subject.filter.length * np.array([-1, -1, 1, 1])
        others = [p for p in self.persons if p is not subject and p.mean_score >= RELIABLE_SCORE]
        boxes = np.array([p.filter.box_at(stamp_ns) for p in others]).reshape(-1, 4)
        edge = 0.01 * max(image_size)
        at_edge = (box[:2] < edge).any() or (box[2:] > np.array(image_size) - edge).any()
        return not ((overlap_coefficient(around[None], boxes) > 0).any() or at_edge)

    def propagate(self, box: np.ndarray, stamp_ns: int) -> None:
        """Update the subject with the pose network's box (4,) px, in an image without detection."""
        subject = self._subject
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
        if self._subject is not None:
            self._subject.filter.update(box, noise=2.0)
            self._subject.confirm(stamp_ns)

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
        # At a low image rate coasting spans at least two missed images.
        interval_s = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) * 1e-9
        self._coast_s = max(self._config.coast_s, min(2.5 * interval_s, FORGET_S))
        self._last_ns = stamp_ns
        for person in self.persons:
            person.filter.predict(stamp_ns)
        appearances = [describe(image, box) for box in boxes]
        assigned = self._assign(boxes, scores, appearances, stamp_ns)
        self._spawn(boxes, scores, appearances, assigned, stamp_ns)
        self._reidentify(stamp_ns)
        self._apply_choice(stamp_ns)
        self._select(image.shape, stamp_ns)
        self._prune(image.shape, stamp_ns)
        self._any_detected = self._any_detected or bool(len(boxes))
        return self._current(stamp_ns)

    def _assign(
        self, boxes: np.ndarray, scores: np.ndarray, appearances: list[np.ndarray | None], stamp_ns: int
    ) -> set[int]:
        """Indices of the assigned detections: first to reliable persons, then to the others, then low scores."""
        subject = self._subject
        persons = [p for p in self.persons if p is not subject or p.unconfirmed_s(stamp_ns) <= self._coast_s]
        reliable = [p for p in persons if p is subject or (p.mean_score >= RELIABLE_SCORE and not p.double)]
        unreliable = [p for p in persons if not any(p is q for q in reliable)]
        high = scores >= self._config.detection_threshold
        assigned: set[int] = set()
        refused: set[int] = set()
        for owners, group in ((reliable, high), (unreliable, high), (reliable, ~high)):
            free = [p for p in owners if p.detected_ns < stamp_ns and id(p) not in refused]
            at = np.array([j for j in np.nonzero(group)[0] if j not in assigned], int)
            pairs = assign(free, boxes[at], scores[at], [appearances[j] for j in at], stamp_ns, group is not high)
            for i, k in pairs:
                person, j = free[i], int(at[k])
                if person is subject:
                    if replaced(subject, boxes[j], appearances[j], stamp_ns):
                        self.persons.append(Person(boxes[j], float(scores[j]), stamp_ns, appearances[j]))
                        refused.add(id(person))
                        assigned.add(j)
                        continue
                    if known_other(subject, self.persons, boxes[j], appearances[j]):
                        refused.add(id(person))  # a low-score detection must not replace it either
                        continue
                person.update(boxes[j], float(scores[j]), stamp_ns)
                if group is high:
                    person.confirm(stamp_ns)
                if not _mixed(boxes, j):
                    person.update_appearance(appearances[j])
                assigned.add(j)
        return assigned

    def _spawn(
        self,
        boxes: np.ndarray,
        scores: np.ndarray,
        appearances: list[np.ndarray | None],
        assigned: set[int],
        stamp_ns: int,
    ) -> None:
        """Start tracks from unassigned detections, except parts of tracked persons."""
        known = boxes[sorted(assigned)].astype(float).reshape(-1, 4)
        subject = self._subject
        if subject is not None and not self._left_image and 0.0 < subject.unconfirmed_s(stamp_ns) <= self._coast_s:
            known = np.concatenate([known, subject.filter.box()[None]])
        for j in range(len(boxes)):
            if j in assigned or scores[j] < self._config.detection_threshold:
                continue
            if len(known) and overlap_coefficient(boxes[j][None].astype(float), known).max() > _PART:
                continue
            person = Person(boxes[j], float(scores[j]), stamp_ns, appearances[j])
            person.double = subject is not None and is_double(subject, boxes[j], appearances[j], stamp_ns)
            self.persons.append(person)

    def _reidentify(self, stamp_ns: int) -> None:
        """Re-identify a lost subject in a new track."""
        lost = self._subject
        if lost is None or lost.unconfirmed_s(stamp_ns) <= 0:
            return
        for person in self.persons:
            if person is lost or person.detected_ns != stamp_ns or person.first_ns <= lost.confirmed_ns:
                continue
            if person.hits < self._config.confirm_frames or not same_person(lost, person, self._left_image):
                continue
            self.persons.remove(lost)
            person.appearance = lost.appearance if lost.appearance is not None else person.appearance
            self._subject = person
            self._left_image = False
            return

    def _apply_roi(self, roi: np.ndarray, stamp_ns: int) -> None:
        """A roi away from the subject is a choice; one on the subject replaces missing detections."""
        subject = self._subject
        if subject is None or iou(roi[None], subject.filter.box()[None])[0, 0] < 0.1:
            self._chosen_box = roi
        elif self._config.subject == "roi" and subject.unconfirmed_s(stamp_ns) > 0.5 * self._coast_s:
            subject.update(roi, 0.0, stamp_ns)
            subject.confirm(stamp_ns)

    def _apply_choice(self, stamp_ns: int) -> None:
        """Make the person in the chosen box the subject."""
        if self._chosen_box is None:
            return
        chosen_box, self._chosen_box = self._chosen_box, None
        detected = [p for p in self.persons if p.detected_ns == stamp_ns]
        overlap = iou(chosen_box[None], np.array([p.box for p in detected]).reshape(-1, 4))[0]
        if len(overlap) and overlap.max() >= 0.2:
            chosen = detected[int(overlap.argmax())]
        else:
            chosen = Person(chosen_box, 0.0, stamp_ns, None)
            self.persons.append(chosen)
        if chosen is not self._subject:
            self._follow(chosen)

    def _select(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """Choose a subject by the configured rule when there is none to wait for."""
        config = self._config
        if config.subject in ("box", "roi"):
            return
        if self._subject is not None:
            if config.on_loss == "wait":
                return
            patience_s = 0.0 if self._left_image else self._coast_s + _GIVE_UP_S
            if self._subject.unconfirmed_s(stamp_ns) <= patience_s:
                return
        candidates = [
            p
            for p in self.persons
            if p.detected_ns == stamp_ns
            and p is not self._subject
            and p.score >= config.detection_threshold
            and (p.hits >= config.confirm_frames or (not self._any_detected and p.score >= _CERTAIN_SCORE))
        ]
        if not candidates:
            return
        if config.subject == "largest":
            best = max(candidates, key=lambda p: float(np.prod(p.box[2:] - p.box[:2])))
        else:
            middle = np.array([shape[1], shape[0]]) / 2
            best = min(candidates, key=lambda p: float(np.linalg.norm((p.box[:2] + p.box[2:]) / 2 - middle)))
        self._follow(best)

    def _follow(self, person: Person) -> None:
        self._subject = person
        self._track_id += 1
        self._left_image = False

    def _prune(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """Delete the tracks of bystanders out of view."""
        subject = self._subject
        if subject is not None:
            self._left_image = subject.undetected_s(stamp_ns) > 0 and (self._left_image or leaving(subject, shape))
        kept = [p for p in self.persons if p is subject or p.undetected_s(stamp_ns) <= _BYSTANDER_S]
        if len(kept) > _MAX_PERSONS:
            kept.sort(key=lambda p: (p is not subject, -p.detected_ns))
        self.persons = kept[:_MAX_PERSONS]

    def _current(self, stamp_ns: int) -> Subject | None:
        subject = self._subject
        if subject is None or subject.unconfirmed_s(stamp_ns) > (0.0 if self._left_image else self._coast_s):
            return None
        if subject.detected_ns == stamp_ns:
            return Subject(self._track_id, subject.box, subject.score, False)
        box = subject.filter.box()
        others = [p.box for p in self.persons if p is not subject and not p.double and p.confirmed_ns == stamp_ns]
        hidden = bool(len(others)) and bool((iou(box[None], np.array(others)) > _HIDDEN_IOU).any())
        return Subject(self._track_id, box, 0.0, hidden)


def _mixed(boxes: np.ndarray, j: int) -> bool:
    """Whether detection ``j`` overlaps another one, so that its appearance is mixed."""
    overlap = iou(boxes[j][None], boxes)[0]
    overlap[j] = 0.0
    return bool((overlap > MIXED_IOU).any())
