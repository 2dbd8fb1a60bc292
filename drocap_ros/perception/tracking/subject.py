"""Single-subject tracker: chooses one person and keeps its identity through crossings and gaps."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum

import numpy as np

from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import MOSTLY, PARTLY, TOUCHES, iou, overlap_coefficient
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import (
    FORGET_S,
    MARGIN,
    ONE_PERSON,
    assign,
    followed_on,
    found_again,
    is_someone_else,
    look_cost,
    mixed,
    place_cost,
)
from drocap_ros.perception.tracking.choice import SubjectChoice
from drocap_ros.perception.tracking.person import (
    DOUBT_S,
    SURE_CONFIDENCE,
    BoxFilter,
    Person,
    Subject,
    boxes_of,
)
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig

_USUAL = 0.9  # share of the usual belief in a pose below which its box counts less,
_LEAST_BELIEF = 0.05  # as if it had this one at least
_SAME_BOX_IOU = 0.6  # overlap from which two boxes of one image are the same: at a half, one around two is not
_EXCHANGED = 2.5  # difference of the looks' costs of two who met from which they were exchanged
_MOST_CHANGES = 1000  # kept of a run that may last for days
_BYSTANDER_S = 2.0  # longest gap of a bystander
_MAX_PERSONS = 30  # in memory: the assignment's time grows with their number
_LEAVING_SPEED = 0.15  # outward speed, lengths/s, of a box at the image's edge that counts as leaving
EDGE = 0.01  # share of the image's longer side within which a box is at its edge


class Change(Enum):
    """What happened to the subject: another track than before, or none; the value ends "person N ..."."""

    CHOSEN = "is followed"
    EXCHANGED = "was exchanged with someone beside, by the look, and is put right"
    FOUND_AGAIN = "is found again by place, size and look"
    LEFT = "left the picture"
    LOST = "is lost from view"


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
        self.subject: Person | None = None  # the last one, lost or not
        #: Lost subjects and their track ids, after whom the rule chose the next one: whoever comes back is it again.
        self._away: list[tuple[int, Person]] = []
        #: Persons whose joints were followed, out of view.
        self.lost: list[Person] = []
        self._track_id = self._last_id = 0
        self._is_shown = False
        #: The last changes of the subject, stamp and words; an exchange keeps the person and is none.
        self.changes: deque[tuple[int, str]] = deque(maxlen=_MOST_CHANGES)
        self.choice = SubjectChoice(config)
        self._coast_s = config.coast_s
        self._last_ns: int | None = None
        #: Detections of the last image that are nobody's.
        self._free = Detections(np.empty((0, 4)), np.empty(0))

    def reset(self) -> None:
        """Delete all tracks, for stamps that restarted; track ids continue."""
        self.persons, self.subject, self.choice.nothing_yet, self._last_ns = [], None, True, None
        self._away, self.lost = [], []

    def move_camera(self, matrix: np.ndarray) -> None:
        """Let all persons follow the image's motion (2, 3) by the camera's, those out of view as well."""
        for person in (*self.persons, *self.lost, *(away for _, away in self._away)):
            person.move_camera(matrix)

    def followed(self, stamp_ns: int) -> Person | None:
        """The subject while it is in view or predicted; None while it is lost, or when it has left the image."""
        subject = self.subject
        lost = subject is None or subject.left_image or subject.unconfirmed_s(stamp_ns) > self._coast_s
        return None if lost else subject

    def detected(self, stamp_ns: int) -> list[Person]:
        """Those detected in the image of this time, without the subject."""
        return [p for p in self.persons if p.detected_ns == stamp_ns and p is not self.subject]

    def beside(self, stamp_ns: int) -> list[Person]:
        """Those of them who certainly were persons."""
        return [p for p in self.detected(stamp_ns) if p.plausible and p.pose.believed_ns is not None]

    def apart(self, person: Person) -> bool:
        """Whether the boxes of a person and of the subject hold two persons, if each holds one."""
        subject = self.subject
        return subject is None or bool(overlap_coefficient(person.box[None], subject.box[None])[0, 0] < MOSTLY)

    @property
    def missed(self) -> bool:
        """Whether the last image did not show the subject."""
        return self.subject is not None and self.subject.detected_ns < (self._last_ns or 0)

    def current(self, stamp_ns: int) -> Subject | None:
        """The subject in the image of the last update."""
        subject = self.subject
        if subject is None or subject.unconfirmed_s(stamp_ns) > (0.0 if subject.left_image else self._coast_s):
            return None
        if subject.detected_ns == stamp_ns:
            return Subject(self._track_id, subject.box, subject.score, False)
        box, confirmed = subject.filter.box(), [p for p in self.persons if p.confirmed_ns == stamp_ns]
        hiding = boxes_of(p for p in confirmed if p is not subject and p.plausible)
        return Subject(self._track_id, box, 0.0, bool((iou(box[None], hiding) > PARTLY).any()))

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

    def other_boxes(self, subject: Subject) -> list[tuple[np.ndarray, float]]:
        """Detections of this image, (4,) px and score, that share most with the subject's and are nobody's.

        They are the person without the shadow or someone else beside it, or the whole person.
        """
        shared = overlap_coefficient(self._free.boxes, subject.box[None])[:, 0] > ONE_PERSON
        same = iou(self._free.boxes, subject.box[None])[:, 0] > _SAME_BOX_IOU
        order = np.argsort(-self._free.scores, kind="stable")
        return [(self._free.boxes[j], float(self._free.scores[j])) for j in order if shared[j] and not same[j]]

    def is_others(self, box: np.ndarray, stamp_ns: int) -> bool:
        """Whether a box (4,) px around the joints that were found for the subject is someone else's of this image."""
        subject = self.subject
        if subject is None:
            return False
        others = [place_cost(p, box[None], expected=True)[0] for p in self.beside(stamp_ns)]
        return bool(min(others, default=np.inf) + MARGIN < place_cost(subject, box[None], expected=True)[0])

    def correct(self, subject: Subject, box: np.ndarray, score: float) -> Subject:
        """The subject at another detection (4,) px of the last image."""
        assert self.subject is not None
        self.subject.correct(box, score)
        return Subject(subject.track_id, self.subject.box, score, False)

    def judge(self, confidence: float, box: np.ndarray, stamp_ns: int, limbs: np.ndarray | None = None) -> None:
        """Add the mean confidence of the subject's pose, found in a box (4,) px, and its limbs (J,) px.

        A subject that has shown no person for seconds is lost from its last certain time on; one that never did was
        none, and the choice is made again.
        """
        subject = self.subject
        if subject is None:
            return
        subject.pose.judge(confidence, box, stamp_ns, limbs=limbs)
        if subject.detected_ns == stamp_ns:
            if subject.pose.believed:  # whoever certainly was a person, and is in view beside it, is someone else
                subject.others.update(p for p in self.beside(stamp_ns) if self.apart(p))
            doubt = _USUAL * subject.pose.usual / max(subject.pose.last, _LEAST_BELIEF)
            if doubt > 1.0:
                subject.filter.remeasure(box, noise=doubt**2)
        if not subject.pose.refuted:
            return
        if subject.pose.box is None:
            self.subject = None
            return
        self.persons.append(subject.remainder(stamp_ns))
        subject.box, subject.filter = subject.pose.box, BoxFilter(subject.pose.box, subject.certain_ns)
        subject.detected_ns = subject.confirmed_ns = subject.certain_ns

    def judge_bystander(
        self,
        person: Person,
        confidence: float,
        stamp_ns: int,
        same: bool = False,
        blurred: bool = False,
        limbs: np.ndarray | None = None,
    ) -> None:
        """Add a bystander's pose: mean confidence, limbs, and whether its joints are the subject's; it may be lost."""
        subject = self.subject
        person.pose.judge(confidence, person.box, stamp_ns, blurred, limbs)
        if subject is not None and subject.pose.believed_ns == stamp_ns:
            apart = self.apart(person)
            if apart and confidence >= SURE_CONFIDENCE:
                subject.others.add(person)
            elif same and not apart:  # a box around the subject and something else
                self.persons.remove(person)
                subject.others.discard(person)
        if self.current(stamp_ns) is None:
            self._reidentify(stamp_ns)

    def update(
        self,
        image: np.ndarray,
        stamp_ns: int,
        boxes: np.ndarray,
        scores: np.ndarray,
        roi: np.ndarray | None = None,
        look: Callable[[], None] | None = None,
    ) -> Subject | None:
        """Update all tracks with one image's detections.

        image : (H, W, 3) uint8 BGR
        stamp_ns : later than the last
        boxes : (N, 4) px; scores : (N,), at least ``low_threshold``
        roi : (4,) px, box of the drone's own tracker, or None
        look : judges persons of this image by their poses, before one of them is chosen
        """
        if roi is not None:
            self._apply_roi(np.asarray(roi, float), stamp_ns)
        if self._last_ns is not None:  # at a low image rate coasting spans at least two missed images
            self._coast_s = max(self._config.coast_s, min(2.5e-9 * (stamp_ns - self._last_ns), FORGET_S))
        self._last_ns = stamp_ns
        for person in self.persons:
            person.filter.predict(stamp_ns)
        seen = Detections(boxes.astype(float), scores, appearances=[describe(image, box) for box in boxes])
        assigned = self._assign(seen, stamp_ns)
        free = [j for j in range(len(boxes)) if j not in assigned]
        self._free = Detections(seen.boxes[free], scores[free])
        self._spawn(seen, assigned, stamp_ns)
        self._reidentify(stamp_ns)
        if look is not None and self.current(stamp_ns) is None:
            self.choice.by_poses = True
            look()
        self._choose(image, stamp_ns)
        self._prune(image.shape, stamp_ns)
        self.choice.nothing_yet &= not len(boxes)
        shown = self.current(stamp_ns)
        if self.subject is not None and shown is None and self._is_shown:
            gone = Change.LEFT if self.subject.left_image else Change.LOST
            self.changes.append((stamp_ns, f"person {self._track_id} {gone.value}"))
        self._is_shown = shown is not None
        return shown

    def _assign(self, seen: Detections, stamp_ns: int) -> set[int]:
        """Update everybody with their detections; returns the indices of these."""
        persons = followed_on(self.subject, self.persons, self._coast_s, stamp_ns)
        if (subject := self.followed(stamp_ns)) is not None:
            persons = [subject, *persons]
        persons = [p for p in persons if p.detected_ns < stamp_ns]
        pairs, blended = assign(persons, seen), mixed(seen)
        for i, j in pairs:
            person = persons[i]
            person.update(seen.boxes[j], float(seen.scores[j]), stamp_ns)
            # A weak detection may be clutter: the pose confirms it.
            if seen.scores[j] >= self._config.detection_threshold:
                person.confirm(stamp_ns)
            if person.pose.believed:
                # Beside the subject either may be taken for the other: what is known of them stays.
                lasting = not blended[j] and stamp_ns - person.met_ns > 1e9 * DOUBT_S
                person.update_appearance(seen.appearances[j], lasting)
        for person in persons:
            person.searched(person.detected_ns == stamp_ns)
        if subject is not None and subject.detected_ns == stamp_ns:
            self._part(subject, stamp_ns)
        return {j for _, j in pairs}

    def _part(self, subject: Person, stamp_ns: int) -> None:
        """Note whom the subject meets; after it, who of the two looks like whom tells whether they were exchanged.

        In each image the places count more than the looks; what the looks say adds up over the images.
        """
        for person in self.detected(stamp_ns):
            if overlap_coefficient(person.box[None], subject.box[None])[0, 0] > PARTLY:
                person.met_ns = subject.met_ns = stamp_ns
            # Of a track that began at the meeting no look is known but the one it has now.
            new = stamp_ns - person.first_ns <= 1e9 * DOUBT_S
            met = stamp_ns - max(person.met_ns, subject.met_ns if new else 0) <= 1e9 * DOUBT_S
            if not met or person.hits < self._config.confirm_frames:
                continue
            own, other = (look_cost(p, [subject.recent, person.recent]) for p in (subject, person))
            if own[0] - own[1] + (0.0 if new else other[1] - other[0]) > _EXCHANGED:
                subject.appearance, person.appearance = subject.recent if new else person.appearance, subject.appearance
                person.others = (subject.others - {person}) | {subject}
                self._follow(person, Change.EXCHANGED, self._track_id)
                return

    def _follow(self, person: Person, change: Change, track_id: int | None = None) -> None:
        """Make a person the subject, a next one without ``track_id``: the one place at which its track changes."""
        self.subject = person
        if track_id is None:
            track_id = self._last_id = self._last_id + 1
        self._track_id = track_id
        person.left_image = False
        self.changes.append((self._last_ns or 0, f"person {track_id} {change.value}"))

    def _spawn(self, seen: Detections, assigned: set[int], stamp_ns: int) -> None:
        """Start tracks from unassigned detections, except parts of tracked persons and second boxes of the subject."""
        # Leaves and signs that were found to be no person may cover one.
        known = boxes_of(p for p in self.persons if p.detected_ns == stamp_ns and p.plausible)
        subject = self.followed(stamp_ns)
        for j in np.nonzero(seen.scores >= self._config.detection_threshold)[0].tolist():
            box = seen.boxes[j][None]
            if j in assigned or (overlap_coefficient(box, known) > ONE_PERSON).any():
                continue
            if subject is not None and not is_someone_else(subject, seen.appearances[j]):
                here = subject.box if subject.detected_ns == stamp_ns else subject.filter.box()
                if iou(box, here[None])[0, 0] > PARTLY or overlap_coefficient(box, here[None])[0, 0] > ONE_PERSON:
                    continue
            self.persons.append(Person(seen.boxes[j], float(seen.scores[j]), stamp_ns, seen.appearances[j]))

    def _reidentify(self, stamp_ns: int) -> None:
        """Re-identify a lost subject in a new track, the first one before those followed in its absence."""
        subject = self.subject
        if subject is None:
            return
        self._away = [(i, p) for i, p in self._away if p.unconfirmed_s(stamp_ns) <= FORGET_S]
        in_view = subject.unconfirmed_s(stamp_ns) <= 0
        lost = [*self._away, *(() if in_view else [(self._track_id, subject)])]
        free = [p for p in self.persons if p is not subject]
        for track_id, last in lost:
            if person := found_again(
                last, [*free, *(p for p in last.others if p not in free)], self._config.confirm_frames, stamp_ns
            ):
                lost.remove((track_id, last))
                self._away = lost
                if not in_view:
                    self.persons.remove(subject)
                person.continue_as(last)
                self._follow(person, Change.FOUND_AGAIN, track_id)
                return

    def _apply_roi(self, roi: np.ndarray, stamp_ns: int) -> None:
        """A roi away from the subject is a choice; one on the subject replaces missing detections."""
        subject = self.subject
        if subject is None or iou(roi[None], subject.filter.box()[None])[0, 0] < TOUCHES:
            self.choice.box = roi
        elif self._config.subject == "roi" and subject.unconfirmed_s(stamp_ns) > 0.5 * self._coast_s:
            subject.update(roi, 0.0, stamp_ns)
            subject.confirm(stamp_ns)

    def _choose(self, image: np.ndarray, stamp_ns: int) -> None:
        """Make a person the subject: the one in a given box, then one by the rule."""
        given = self.choice.given(image, self.persons, stamp_ns)
        if given is not None and given not in self.persons:
            self.persons.append(given)
        if given is not None and given is not self.subject:
            given.pose.choose(given.box, stamp_ns)
            self._away = []
            self._follow(given, Change.CHOSEN)
        first = not self._track_id
        best = self.choice.by_rule(self.persons, self.subject, image.shape, stamp_ns, self._coast_s, first)
        if best is None:
            return
        if self.subject is not None and self.current(stamp_ns) is None and not self.subject.nobody:
            self.persons.remove(self.subject)
            self._away.append((self._track_id, self.subject))
        self._follow(best, Change.CHOSEN)

    def _prune(self, shape: tuple[int, ...], stamp_ns: int) -> None:
        """Delete the tracks of bystanders out of view."""
        subject = self.subject
        if subject is not None:
            subject.left_image = subject.undetected_s(stamp_ns) > 0 and (subject.left_image or _leaving(subject, shape))
            subject.others = {p for p in subject.others if p.undetected_s(stamp_ns) <= FORGET_S}
        here = boxes_of(self.detected(stamp_ns))
        kept = [p for p in self.persons if p is subject or p.undetected_s(stamp_ns) <= _BYSTANDER_S or _behind(p, here)]
        gone = [p for p in self.persons if p.joints is not None and p not in kept]
        self.lost = [p for p in (*self.lost, *gone) if p.unconfirmed_s(stamp_ns) <= FORGET_S]
        if len(kept) > _MAX_PERSONS:
            kept.sort(key=lambda p: (p is not subject, -p.detected_ns))
        self.persons = kept[:_MAX_PERSONS]


def _behind(person: Person, others: np.ndarray) -> bool:
    """Whether the joints of a person are expected behind somebody in boxes (N, 4) px, where they stay until then."""
    joints = person.joints
    return joints is not None and bool((overlap_coefficient(joints.box[None], others) > MOSTLY).any())


def _leaving(person: Person, image_shape: tuple[int, ...]) -> bool:
    """Whether the person's last box touches an edge of the image and moves outwards."""
    height, width = image_shape[:2]
    edge = EDGE * max(width, height)
    x0, y0, x1, y1 = person.box
    vx, vy = person.filter.x[:2, 1] / person.filter.length
    out = ((x0 < edge, -vx), (x1 > width - edge, vx), (y0 < edge, -vy), (y1 > height - edge, vy))
    return any(at_edge and speed > _LEAVING_SPEED for at_edge, speed in out)
