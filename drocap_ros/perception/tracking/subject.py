"""The subject: chosen once, kept through crossings and gaps, never swapped for somebody else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import ParameterError
from drocap_ros.perception.detection.nms import iou, shared
from drocap_ros.perception.perception_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import assign
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.search import Window, tiles, window_around

#: Overlap with another person from which a predicted box is taken to be hidden behind them.
_HIDDEN_IOU = 0.25
#: Overlap above which two persons' looks mix and are not learned.
_MIXED_IOU = 0.1
#: Below this likeness a detection that might also be somebody else is not the subject's.
_STRANGE_LOOK = 0.85
#: Below this, all of a sudden and at the same size, it is somebody else: sun and shade change one's own look to 0.8,
#: stooping and coming in bit by bit to 0.6, but these change the box as well.
_OTHER_LOOK, _SUDDEN_S, _SAME_SIZE = 0.7, 0.15, 0.2
#: Quality from which a subject is seen clearly, so that its look can be trusted.
_CLEARLY_SEEN = 0.6
#: By so much somebody else's look must fit better.
_LOOK_MARGIN = 0.05
#: Least quality of a bystander who may claim a detection from the subject; parts and clutter score below.
_SOLID_QUALITY = 0.4
#: Overlap with the predicted box of a detection that leaves no doubt.
_CLEAR_IOU = 0.5
#: Outward speed, lengths/s, of a box at the picture's edge that counts as leaving.
_LEAVING_SPEED = 0.15
#: Share of the smaller box inside the larger from which both are one person.
_PART = 0.75
#: Distance to the next person, lengths, from which nobody is near.
_ALONE = 0.4
#: A person found so recently is looked at again before the search goes on.
_CANDIDATE_S = 0.3
#: A bystander unseen for so long is forgotten.
_BYSTANDER_S = 2.0
#: Persons remembered at most; a crowd's rest is of no use.
_MOST_PERSONS = 30
#: A new person with this score needs no confirmation by further images when nothing was seen before.
_SURE_SCORE = 0.6


@dataclass(frozen=True)
class Subject:
    """The subject in one image.

    track_id : 1, 2, ...
    box : (4,) x_min y_min x_max y_max px, detected, or predicted while ``score`` is 0
    score : the detector's score; 0 = predicted
    hidden : predicted where somebody else stands: keypoints found there would be theirs
    """

    track_id: int
    box: np.ndarray
    score: float
    hidden: bool


class SubjectTracker:
    """Keeps one person apart from all others.

    All persons in view are followed, so that in a crossing each detection has its own owner.  A subject
    without detection is predicted for ``coast_s``; then there is no subject until a person appears who was
    not in view together with the subject, looks like it and could have come there in the time.
    """

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._config = config
        self._persons: list[Person] = []
        self._subject: Person | None = None
        self._track_id = 0
        self._left = False
        self._wanted: np.ndarray | None = parse_box(config.subject_box) if config.subject == "box" else None
        self._full_ns: int | None = None
        self._tile = 0
        self._turn = False
        self._started = False
        self._coast_s = config.coast_s
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Forget all persons, since time began anew; track ids go on."""
        self._persons, self._subject, self._full_ns, self._started, self._last_ns = [], None, None, False, None

    def choose(self, box: np.ndarray) -> None:
        """Make the person in this box (4,) px the subject from the next image on, under a new track_id."""
        self._wanted = np.asarray(box, float)

    def windows(
        self, image_size: tuple[int, int], stamp_ns: int, one: bool = False, quick: bool = False
    ) -> list[Window | None]:
        """Parts of the next image to detect in; None = all of it.

        Near the subject while it is in view, and over the whole at intervals; without it over the whole and
        around somebody just found, else one tile of a large image in turn.  With ``one`` there is time for one look:
        then these take turns; with ``quick`` the window is closer around the subject.
        """
        if self._wanted is not None:
            near = window_around(self._wanted, image_size)
            return [near] if one else list({near: None, None: None})
        subject = self._subject
        if subject is not None and subject.unsure_s(stamp_ns) <= self._coast_s:
            near = window_around(subject.motion.box_at(stamp_ns), image_size, quick=quick)
            due = self._full_ns is None or stamp_ns - self._full_ns >= self._config.full_frame_every_s * 1e9
            if near is None or due or stamp_ns < (self._full_ns or 0):
                self._full_ns = stamp_ns
                return [None] if one else list({near: None, None: None})
            return [near]
        self._full_ns = stamp_ns
        self._turn = not self._turn
        if one and not self._turn:
            return [None]
        near, tiled = self._candidate_window(image_size, stamp_ns), tiles(image_size)
        if near is None and tiled:
            self._tile = (self._tile + 1) % len(tiled)
            near = tiled[self._tile]
        if near is None:
            return [None]
        return [near] if one else [None, near]

    def _candidate_window(self, image_size: tuple[int, int], stamp_ns: int) -> Window | None:
        """Window around somebody just found who may become the subject: the whole image may not show them again."""
        lost = self._subject
        recent = [p for p in self._persons if p is not lost and p.gap_s(stamp_ns) <= _CANDIDATE_S]
        if lost is not None:  # who was in view together with the subject is not the subject come back
            recent = [p for p in recent if p.first_ns > lost.sure_ns]
        if not recent:
            return None
        best = max(recent, key=lambda p: (p.hits < self._config.confirm_frames, p.quality))
        return window_around(best.motion.box_at(stamp_ns), image_size)

    def in_view(self, stamp_ns: int) -> Subject | None:
        """The subject predicted, if it was surely seen in the last image that was searched."""
        subject = self._subject
        if subject is None or self._wanted is not None or self._last_ns is None or subject.sure_ns != self._last_ns:
            return None
        return Subject(self._track_id, subject.motion.box_at(stamp_ns), subject.score, False)

    def steady(self, image_size: tuple[int, int], stamp_ns: int) -> Subject | None:
        """The subject predicted, if it was seen in the last image, stands free of others and clear of the edges."""
        predicted, subject = self.in_view(stamp_ns), self._subject
        if predicted is None or subject is None:
            return None
        full_due = self._full_ns is None or stamp_ns - self._full_ns >= self._config.full_frame_every_s * 1e9
        box = predicted.box
        reach = _ALONE * subject.motion.length
        around = box + reach * np.array([-1, -1, 1, 1])
        solid = [p for p in self._persons if p is not subject and p.quality >= _SOLID_QUALITY]
        others = np.array([p.motion.box_at(stamp_ns) for p in solid]).reshape(-1, 4)
        near = (shared(around[None], others) > 0).any()
        edge = 0.01 * max(image_size)
        at_edge = (box[:2] < edge).any() or (box[2:] > np.array(image_size) - edge).any()
        if full_due or near or at_edge:
            return None
        return predicted

    def carry(self, box: np.ndarray, stamp_ns: int) -> None:
        """Take the subject's box (4,) px from the pose network, in an image without detection."""
        subject = self._subject
        if subject is None:
            return
        for person in self._persons:
            person.motion.predict(stamp_ns)
        subject.motion.update(box)
        subject.box = np.asarray(box, float)
        subject.assure(stamp_ns)
        self._last_ns = stamp_ns

    def second_look(
        self, image_size: tuple[int, int], stamp_ns: int, boxes: np.ndarray, scores: np.ndarray
    ) -> Window | None:
        """A tighter window for a subject whom the first detections (N, 4), (N,) do not show clearly, or None."""
        subject = self._subject
        if subject is None or self._wanted is not None or subject.unsure_s(stamp_ns) > self._coast_s:
            return None
        box = subject.motion.box_at(stamp_ns)
        clear = scores >= self._config.detection_threshold
        if clear.any() and iou(box[None], boxes[clear].astype(float)).max() > _CLEAR_IOU:
            return None
        return window_around(box, image_size, tight=True)

    def update(
        self, image: np.ndarray, stamp_ns: int, boxes: np.ndarray, scores: np.ndarray, roi: np.ndarray | None = None
    ) -> Subject | None:
        """Take in one image's detections.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        stamp_ns : later than the last
        boxes : (N, 4) px; scores : (N,), both of at least ``low_threshold``
        roi : (4,) px, the drone's own box of the person it tracks, or None
        """
        if roi is not None:
            self._take_roi(np.asarray(roi, float), stamp_ns)
        # At a few images a second two missed ones are already long.
        interval_s = 0.0 if self._last_ns is None else (stamp_ns - self._last_ns) * 1e-9
        self._coast_s = max(self._config.coast_s, min(2.5 * interval_s, self._config.forget_s))
        self._last_ns = stamp_ns
        for person in self._persons:
            person.motion.predict(stamp_ns)
        looks = [describe(image, box) for box in boxes]
        used = self._match(boxes, scores, looks, stamp_ns)
        self._welcome(boxes, scores, looks, used, stamp_ns)
        self._retake(stamp_ns)
        self._settle_choice(boxes, stamp_ns)
        self._select(image.shape, stamp_ns)
        self._forget(image.shape, stamp_ns)
        self._started = self._started or bool(len(boxes))
        return self._report(stamp_ns)

    def confirm(self, box: np.ndarray, stamp_ns: int) -> None:
        """Tell that the pose network found the subject where it is predicted or doubtful, at ``box`` (4,) px."""
        if self._subject is not None:
            self._subject.motion.update(box, noise=2.0)
            self._subject.assure(stamp_ns)

    def _match(self, boxes: np.ndarray, scores: np.ndarray, looks: list[np.ndarray | None], stamp_ns: int) -> set[int]:
        """Sure detections to known persons, then to those who may be clutter, then the doubtful ones.

        Returns the detections that have an owner.
        """
        persons = [p for p in self._persons if p is not self._subject or p.unsure_s(stamp_ns) <= self._coast_s]
        solid = [p for p in persons if p is self._subject or p.quality >= _SOLID_QUALITY]
        thin = [p for p in persons if not any(p is q for q in solid)]
        sure = scores >= self._config.detection_threshold
        used: set[int] = set()
        refused: set[int] = set()
        for owners, wanted in ((solid, sure), (thin, sure), (solid, ~sure)):
            free = [p for p in owners if p.seen_ns < stamp_ns and id(p) not in refused]
            at = np.array([j for j in np.nonzero(wanted)[0] if j not in used], int)
            pairs = assign(free, boxes[at], scores[at], [looks[j] for j in at], stamp_ns, tight=wanted is not sure)
            for i, k in pairs:
                person, j = free[i], int(at[k])
                if person is self._subject and self._replaced(boxes[j], looks[j], stamp_ns):
                    # A newcomer in the subject's place owns this detection from now on.
                    self._persons.append(Person(boxes[j], float(scores[j]), stamp_ns, looks[j]))
                    refused.add(id(person))
                    used.add(j)
                    continue
                if person is self._subject and self._stranger(boxes[j], looks[j]):
                    refused.add(id(person))  # nor may a doubtful detection stand in for it
                    continue
                person.see(boxes[j], float(scores[j]), stamp_ns)
                if wanted is sure:
                    person.assure(stamp_ns)
                if not self._mixed(boxes, j):
                    person.learn_look(looks[j])
                used.add(j)
        return used

    def _replaced(self, box: np.ndarray, look: np.ndarray | None, stamp_ns: int) -> bool:
        """Whether from one image to the next somebody of the same size but another look stands there."""
        subject = self._subject
        if subject is None or look is None or not subject.look_settled or subject.gap_s(stamp_ns) > _SUDDEN_S:
            return False
        if subject.quality < _CLEARLY_SEEN:
            return False
        growth = np.abs(np.log(np.maximum(box[2:] - box[:2], 1.0) / np.maximum(subject.box[2:] - subject.box[:2], 1.0)))
        return bool(growth.max() < _SAME_SIZE) and subject.likeness(look) < _OTHER_LOOK

    def _stranger(self, box: np.ndarray, look: np.ndarray | None) -> bool:
        """Whether a detection near the subject looks unlike it and more like somebody else who was there."""
        if self._subject is None or look is None:
            return False
        own = self._subject.likeness(look)
        if own >= _STRANGE_LOOK:
            return False
        others = [p for p in self._persons if p is not self._subject and p.quality >= _SOLID_QUALITY]
        near = np.array([p.motion.box() for p in others]).reshape(-1, 4)
        close = iou(box[None].astype(float), near)[0] > _MIXED_IOU
        return any(p.likeness(look) > own + _LOOK_MARGIN for p, at in zip(others, close, strict=True) if at)

    def _mixed(self, boxes: np.ndarray, j: int) -> bool:
        overlap = iou(boxes[j][None], boxes)[0]
        overlap[j] = 0.0
        return bool((overlap > _MIXED_IOU).any())

    def _welcome(
        self, boxes: np.ndarray, scores: np.ndarray, looks: list[np.ndarray | None], used: set[int], stamp_ns: int
    ) -> None:
        """Remember sure detections without an owner as new persons."""
        known = boxes[sorted(used)].astype(float).reshape(-1, 4)
        subject = self._subject
        if subject is not None and not self._left and 0.0 < subject.unsure_s(stamp_ns) <= self._coast_s:
            known = np.concatenate([known, subject.motion.box()[None]])
        for j in range(len(boxes)):
            if j in used or scores[j] < self._config.detection_threshold:
                continue
            # A part of somebody known, or somebody known with more around.
            if len(known) and shared(boxes[j][None].astype(float), known).max() > _PART:
                continue
            self._persons.append(Person(boxes[j], float(scores[j]), stamp_ns, looks[j]))

    def _retake(self, stamp_ns: int) -> None:
        """Recognize a lost subject in a newcomer."""
        lost = self._subject
        if lost is None or lost.unsure_s(stamp_ns) <= 0:
            return
        for person in self._persons:
            if person is lost or person.seen_ns != stamp_ns or person.first_ns <= lost.sure_ns:
                continue
            if person.hits < self._config.confirm_frames or not self._plausible(lost, person):
                continue
            self._persons.remove(lost)
            person.look = lost.look if lost.look is not None else person.look
            self._subject = person
            self._left = False
            return

    def _plausible(self, lost: Person, person: Person) -> bool:
        """Whether a newcomer looks like the lost subject and can have come there in the time."""
        gap = (person.first_ns - lost.sure_ns) * 1e-9
        if gap > self._config.forget_s:
            return False
        start, end = lost.box, person.box
        length = max(lost.motion.length, 1.0)
        distance = float(np.linalg.norm((start[:2] + start[2:] - end[:2] - end[2:]) / 2)) / length
        growth = abs(float(np.log(max(end[3] - end[1], end[2] - end[0], 1.0) / length)))
        threshold = self._config.appearance_threshold
        if self._left:
            # Who comes back into the picture comes back where they left it, and must look the same twice over.
            return distance < 1.5 and person.likeness(lost.look) >= 0.5 * (1 + threshold)
        return distance < 1.0 + 1.5 * gap and growth < 0.5 + 0.3 * gap and person.likeness(lost.look) >= threshold

    def _take_roi(self, roi: np.ndarray, stamp_ns: int) -> None:
        """A new roi is a choice; one that stays on the subject carries it on where the detector is blind."""
        subject = self._subject
        if subject is None or iou(roi[None], subject.motion.box()[None])[0, 0] < 0.1:
            self._wanted = roi
        elif self._config.subject == "roi" and subject.unsure_s(stamp_ns) > 0.5 * self._coast_s:
            subject.see(roi, 0.0, stamp_ns)
            subject.assure(stamp_ns)

    def _settle_choice(self, boxes: np.ndarray, stamp_ns: int) -> None:
        if self._wanted is None:
            return
        wanted, self._wanted = self._wanted, None
        seen = [p for p in self._persons if p.seen_ns == stamp_ns]
        overlap = iou(wanted[None], np.array([p.box for p in seen]).reshape(-1, 4))[0]
        if len(overlap) and overlap.max() >= 0.2:
            chosen = seen[int(overlap.argmax())]
        else:
            chosen = Person(wanted, 0.0, stamp_ns, None)
            self._persons.append(chosen)
        if chosen is not self._subject:
            self._follow(chosen)

    def _select(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """The standing choice, where there is no subject to wait for."""
        config = self._config
        if config.subject in ("box", "roi"):
            return
        if self._subject is not None:
            if config.on_loss == "wait":
                return
            patience = 0.0 if self._left else self._coast_s + config.give_up_s
            if self._subject.unsure_s(stamp_ns) <= patience:
                return
        sure = [
            p
            for p in self._persons
            if p.seen_ns == stamp_ns
            and p is not self._subject
            and p.score >= config.detection_threshold
            and (p.hits >= config.confirm_frames or (not self._started and p.score >= _SURE_SCORE))
        ]
        if not sure:
            return
        if config.subject == "largest":
            best = max(sure, key=lambda p: float(np.prod(p.box[2:] - p.box[:2])))
        else:
            middle = np.array([shape[1], shape[0]]) / 2
            best = min(sure, key=lambda p: float(np.linalg.norm((p.box[:2] + p.box[2:]) / 2 - middle)))
        self._follow(best)

    def _follow(self, person: Person) -> None:
        self._subject = person
        self._track_id += 1
        self._left = False

    def _forget(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        subject = self._subject
        if subject is not None:
            self._left = subject.gap_s(stamp_ns) > 0 and (self._left or _leaving(subject, shape))
        kept = [p for p in self._persons if p is subject or p.gap_s(stamp_ns) <= _BYSTANDER_S]
        if len(kept) > _MOST_PERSONS:
            kept.sort(key=lambda p: (p is not subject, -p.seen_ns))
        self._persons = kept[:_MOST_PERSONS]

    def _report(self, stamp_ns: int) -> Subject | None:
        subject = self._subject
        if subject is None or subject.unsure_s(stamp_ns) > (0.0 if self._left else self._coast_s):
            return None
        if subject.seen_ns == stamp_ns:
            return Subject(self._track_id, subject.box, subject.score, False)
        box = subject.motion.box()
        others = [p.box for p in self._persons if p is not subject and p.sure_ns == stamp_ns]
        hidden = bool(len(others)) and bool((iou(box[None], np.array(others)) > _HIDDEN_IOU).any())
        return Subject(self._track_id, box, 0.0, hidden)


def _leaving(person: Person, shape: tuple[int, ...]) -> bool:
    """Whether the person was at an edge of the picture when last seen, moving outwards."""
    height, width = shape[:2]
    edge = 0.01 * max(width, height)
    x0, y0, x1, y1 = person.box
    vx, vy = person.motion.x[:2, 1] / person.motion.length
    out = ((x0 < edge, -vx), (x1 > width - edge, vx), (y0 < edge, -vy), (y1 > height - edge, vy))
    return any(at_edge and speed > _LEAVING_SPEED for at_edge, speed in out)


def parse_box(text: str) -> np.ndarray:
    """(4,) x_min y_min x_max y_max from "x,y,x,y".

    Raises
    ------
    ParameterError
        When the text is no such box.
    """
    try:
        box = np.array([float(v) for v in text.split(",")])
    except ValueError:
        box = np.empty(0)
    if box.shape != (4,) or not np.isfinite(box).all() or (box[2:] <= box[:2]).any():
        raise ParameterError(f"subject_box: expected x_min,y_min,x_max,y_max px, got {text!r}; correct it")
    return box
