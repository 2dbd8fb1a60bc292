"""Track of one person, the subject or a bystander, with the belief in its poses; the subject in one image."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drocap_ros.perception.detection.nms import PARTLY, TOUCHES, areas_of, iou, overlap_coefficient
from drocap_ros.perception.tracking.camera_motion import moved_box
from drocap_ros.perception.tracking.own_joints import LEAST_JOINTS, SLOW_RATE, ExpectedJoints

#: Standard deviation of a measured box: centre in lengths, logarithm of the sizes.
_MEASURED = np.array([0.03, 0.03, 0.08, 0.08])
_EDGE = 0.06  # standard deviation of an edge of a detection, lengths
#: That of the acceleration, lengths/s^2 and 1/s^2: a runner turns at about 1 g, 5 lengths/s^2; the camera adds to it.
_ACCELERATION = np.array([8.0, 8.0, 2.0, 2.0])
#: That of the first rate, lengths/s and 1/s: a run.
_FIRST_RATE = np.array([2.0, 2.0, 0.5, 0.5])
_CAMERA = 0.5  # deviation of the camera's motion at the person, share: water and crowds that move are followed, too
_DECAY_S = np.array([1.0, 1.0, 0.3, 0.3])  # time in which a rate without measurements falls to a third
PREDICTION_S = 0.4  # longest: persons turn, stoop or stop within it


class BoxFilter:
    """Kalman filter of centre (px) and logarithm of width and height.

    State ``x`` (4, 2): value, rate per second; covariance ``p`` (4, 2, 2).
    """

    def __init__(self, box: np.ndarray, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns
        self.x = np.stack([_to_state(box), np.zeros(4)], 1)
        self.p = np.zeros((4, 2, 2))
        self.p[:, 0, 0] = self._scaled(_MEASURED) ** 2
        self.p[:, 1, 1] = self._scaled(_FIRST_RATE) ** 2
        self._before = self.x, self.p

    def _scaled(self, values: np.ndarray) -> np.ndarray:
        scaled: np.ndarray = values * np.array([self.length, self.length, 1.0, 1.0])
        return scaled

    def box(self) -> np.ndarray:
        """(4,) x_min y_min x_max y_max px."""
        return _to_box(self.x[:, 0])

    def box_at(self, stamp_ns: int) -> np.ndarray:
        """(4,) px predicted for a time; the state stays."""
        dt = float(np.clip((stamp_ns - self.stamp_ns) * 1e-9, 0.0, PREDICTION_S))
        x = self.x[:, 0] + dt * self.x[:, 1]
        return _to_box(np.concatenate([x[:2], np.clip(x[2:], 0.0, 10.0)]))

    @property
    def length(self) -> float:
        """Longer side of the box, px: the size of a person in any posture."""
        return float(np.exp(self.x[2:, 0].max()))

    def predict(self, stamp_ns: int) -> None:
        """Advance to a later time; velocities decay without measurements."""
        dt = min((stamp_ns - self.stamp_ns) * 1e-9, PREDICTION_S)
        self.stamp_ns = stamp_ns
        if dt <= 0:
            return
        self.x[:, 0] += dt * self.x[:, 1]
        self.x[:, 1] *= np.exp(-dt / _DECAY_S)
        self.x[2:, 0] = np.clip(self.x[2:, 0], 0.0, 10.0)
        q = self._scaled(_ACCELERATION) ** 2
        f = np.array([[1.0, dt], [0.0, 1.0]])
        noise = np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]])
        self.p = f @ self.p @ f.T + q[:, None, None] * noise

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        before = self.x[:2, 0].copy()
        self.x[:2] = matrix[:, :2] @ self.x[:2]
        self.x[:2, 0] += matrix[:, 2]
        self.p[:2, 0, 0] += (_CAMERA * (self.x[:2, 0] - before)) ** 2
        self.x[2:, 0] += 0.5 * np.log(abs(np.linalg.det(matrix[:, :2])))

    def edges(self, boxes: np.ndarray, length: float, moves: bool) -> tuple[np.ndarray, np.ndarray, float]:
        """Deviations (N, 4) of the edges of boxes (N, 4) px from the predicted ones, and weights (4,) of these.

        Also how much wider the place spreads than a measurement.  Cover takes away one edge at a time, so each counts
        alone; but an error of the prediction is one of two edges, each of which has half its weight.

        length : px, of the whole person: the box of one who is half hidden is shorter
        moves : False = what is in the box stays in its place; the spread is that of a measurement
        """
        size = np.exp(self.x[2:, 0])
        measured = (_EDGE * max(length, self.length)) ** 2
        own = (self.p[:2, 0, 0] + size**2 / 4 * self.p[2:, 0, 0]) * moves
        variance = measured + own
        weight = np.tile((measured + own / 2) / variance, 2)
        return (boxes - self.box()) / np.tile(np.sqrt(variance), 2), weight, float(np.sqrt(variance.prod()) / measured)

    def update(self, box: np.ndarray, noise: float = 1.0) -> None:
        """Update with a measured box; ``noise`` scales its standard deviation."""
        self._before = self.x.copy(), self.p.copy()
        r = (noise * self._scaled(_MEASURED)) ** 2
        innovation = _to_state(box) - self.x[:, 0]
        gain = self.p[:, :, 0] / (self.p[:, 0, 0] + r)[:, None]
        self.x += gain * innovation[:, None]
        self.p -= gain[:, :, None] * self.p[:, None, 0, :]

    @property
    def expected(self) -> BoxFilter:
        """The filter before its last update."""
        before = copy.copy(self)
        before.x, before.p = self._before
        return before

    def remeasure(self, box: np.ndarray, noise: float) -> None:
        """Update with a box in place of the last measured one; ``noise`` as for :meth:`update`."""
        self.x, self.p = self._before
        self.update(box, noise)


def _to_state(box: np.ndarray) -> np.ndarray:
    x0, y0, x1, y1 = (float(v) for v in box)
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, np.log(max(x1 - x0, 1.0)), np.log(max(y1 - y0, 1.0))])


def _to_box(state: np.ndarray) -> np.ndarray:
    half = np.exp(state[2:]) / 2
    return np.concatenate([state[:2] - half, state[:2] + half])


#: Mean confidence of the joints of a believable pose from here on: shadows have 0.2 to 0.6, persons in bad light or
#: from steeply above 0.5 to 0.9;
CONFIRM_CONFIDENCE = 0.5
#: of a pose that is certainly a person's from here on.
SURE_CONFIDENCE = 0.7
_IMPLAUSIBLE = 0.45  # recent mean confidence of a track without a person
_USUAL_SHARE = 0.7  # least share of the usual confidence that is believed: persons of 0.9 do not stay at 0.6
_RECENT_RATE = 0.3  # weight of a new value in recent means, of some three images
QUESTION_S = 1.0  # time of poses without belief after which a track is questioned, and of a newcomer who counts,
_DROP_S = 2.5  # after which one without a person is dropped,
DOUBT_S = 3.0  # and over which a last detection, or a meeting of two in which they may be exchanged, counts
#: Deviation of a person's limbs in the image from their recent lengths, shares of the body's: poses of one person have
#: 0.02 to 0.05, who runs 0.1, two persons' or shadows' 0.1 to 0.4;
_LIMBS = 0.08
_LIMBS_PER_S = 0.15  # and more per second (root of the variance): persons turn and stoop
#: Sum of the confidence's excess over a believable one, at least 0, from which a track is a person: three clear poses
#: or ten doubtful ones.  Clutter and shadows are believable by chance, and not for long.
_ESTABLISHED = 1.0
_NOBODY = 2.0  # sum of what its poses lack, from which a track that was never established is nobody
_SPEED = 1.5  # lengths/s by which a person may deviate from the predicted motion: who falls gains 3 in half a second
_INSIDE = 0.8  # share of a detection in a drawn box from which it is inside
_LONG_AGO_NS = 10**18
#: First, least and largest recent share of detections of a person, and the weight of a new image in it.
_FIRST_RATE_SEEN, _RATES, _SEEN_RATE = 0.5, (0.2, 0.9), 0.2


class PoseBelief:
    """History of the pose confidence of one track.

    length : px, usual longer side of the believable boxes; partly hidden persons have shorter ones
    value, last : recent mean of the confidence, and that of the last pose; NaN before the first one
    judged, mean : number of poses, and the mean of all; usual : mean confidence of the believable poses
    judged_ns : last pose; believed_ns, box : last believable one and its box (4,) px, None = none yet
    plausible_ns, began : from when on the track was a person, as far as its poses show, and its box (4,) px then, which
        follows the camera; None = it is none
    """

    def __init__(self, box: np.ndarray, stamp_ns: int) -> None:
        self.value = self.last = float("nan")
        self.judged_ns: int | None = None
        self.believed_ns: int | None = None
        self.box: np.ndarray | None = None
        self.plausible_ns: int | None = stamp_ns
        self.began = np.asarray(box, float)
        self.length = 0.0
        self.usual = 0.0
        self._limbs: np.ndarray | None = None
        self._poses = 0
        self._support, self._established, self.mean, self.judged = 0.0, False, 0.0, 0
        self._failing_ns: int | None = None

    def judge(
        self, confidence: float, box: np.ndarray, stamp_ns: int, blurred: bool = False, limbs: np.ndarray | None = None
    ) -> None:
        """Add a pose by its mean confidence, found in a box (4,) px; a weak one in a blurred image says nothing.

        limbs : (J,) px, lengths in the image; a pose whose limbs are not the person's is another body's, or several'
        """
        if blurred and confidence < CONFIRM_CONFIDENCE:
            self.judged_ns = stamp_ns
            return
        if limbs is not None:
            confidence *= self.fit(limbs, stamp_ns)
            limbs = limbs / (self.length or float((box[2:] - box[:2]).max()))
        first = np.isnan(self.value) or (self.plausible_ns is None and confidence >= CONFIRM_CONFIDENCE)
        self.value = confidence if first else self.value + _RECENT_RATE * (confidence - self.value)
        self.last, self.judged_ns = confidence, stamp_ns
        self.judged += 1
        self.mean += (confidence - self.mean) / self.judged
        self._support = max(self._support + confidence - CONFIRM_CONFIDENCE, 0.0)
        self._established |= self._support >= _ESTABLISHED
        if confidence >= max(CONFIRM_CONFIDENCE, _USUAL_SHARE * self.usual):
            self.choose(box, stamp_ns, known=False)
            self.usual = confidence if not self.usual else self.usual + SLOW_RATE * (confidence - self.usual)
            if limbs is not None:
                self._poses += 1
                known = limbs if self._limbs is None else np.where(np.isnan(self._limbs), limbs, self._limbs)
                self._limbs = known + max(_RECENT_RATE, 1 / self._poses) * np.nan_to_num(limbs - known)
            return
        if self._failing_ns is None:
            self._failing_ns = stamp_ns
        if self.value < _IMPLAUSIBLE:
            self.plausible_ns = None

    def fit(self, limbs: np.ndarray, stamp_ns: int) -> float:
        """Likelihood of limbs (J,) px as the person's, 1 = as they were, or unknown."""
        if self._limbs is None or self.believed_ns is None:
            return 1.0
        off = (limbs / self.length - self._limbs) ** 2
        if np.isfinite(off).sum() < LEAST_JOINTS:
            return 1.0
        # Few poses tell little about the usual lengths.
        variance = _LIMBS**2 * (1 + 1 / self._poses) + _LIMBS_PER_S**2 * (stamp_ns - self.believed_ns) * 1e-9
        return float(np.exp(-0.5 * np.nanmean(off) / variance))

    def choose(self, box: np.ndarray, stamp_ns: int, *, known: bool = True) -> None:
        """Believe a box (4,) px, whatever its pose where a user or a drone's tracker gave it (``known``)."""
        self.believed_ns, self.box, self._failing_ns = stamp_ns, np.array(box, float), None
        self._established |= known
        if self.plausible_ns is None:
            self.plausible_ns, self.began = stamp_ns, self.box
        length = float((self.box[2:] - self.box[:2]).max())
        self.length = length if not self.length else self.length + SLOW_RATE * (length - self.length)

    def growth(self, box: np.ndarray, length: float) -> float:
        """Absolute logarithm of the size of a box (4,) px over the last or the usual one, whichever is nearer.

        length : px, of the person before there is a believable box
        """
        size = max(float((box[2:] - box[:2]).max()), 1.0)
        known = [length] if self.box is None else [self.length, float((self.box[2:] - self.box[:2]).max())]
        return min(abs(float(np.log(size / max(value, 1.0)))) for value in known)

    def refute(self, confidence: float, stamp_ns: int) -> None:
        """Mark the track as no person, by a pose that lost against another one."""
        self.value, self.last, self.judged_ns, self.plausible_ns = confidence, confidence, stamp_ns, None
        self._failing_ns = stamp_ns

    @property
    def established(self) -> bool:
        """Whether it was a person beyond chance; a track without poses is believed."""
        return self._established or self.judged_ns is None

    @property
    def believed(self) -> bool:
        """Whether the last pose was believable; a track without poses is believed."""
        return self._failing_ns is None

    @property
    def questioned(self) -> bool:
        """Whether the poses have not been believable for a second."""
        return self._fails(QUESTION_S)

    @property
    def refuted(self) -> bool:
        """Whether the poses have shown for seconds that there is no person."""
        return self._fails(_DROP_S) and self.value < _IMPLAUSIBLE

    def _fails(self, seconds: float) -> bool:
        if self._failing_ns is None or self.judged_ns is None:
            return False
        return (self.judged_ns - self._failing_ns) * 1e-9 >= seconds


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
    rate : recent share of the searched images that detected it
    left_image : whether it left at an edge of the image; set for the subject only
    others : tracks that were certainly persons in an image of it as the subject, hence not this one
    met_ns : last time at which its box overlapped the subject's, the subject's that of anybody
    recent : appearance in the last few images
    pose : what its poses say about it
    joints : where its joints are expected, where everybody's are followed
    """

    def __init__(self, box: np.ndarray, score: float, stamp_ns: int, appearance: np.ndarray | None) -> None:
        self.filter = BoxFilter(box, stamp_ns)
        self.box = np.asarray(box, float)
        self.first_ns = self.detected_ns = self.confirmed_ns = stamp_ns
        self.score = self.mean_score = score
        self.hits = 1
        self.rate, self.left_image = _FIRST_RATE_SEEN, False
        self.others: set[Person] = set()
        self.met_ns = stamp_ns - _LONG_AGO_NS
        self.pose = PoseBelief(box, stamp_ns)
        self.joints: ExpectedJoints | None = None
        self.appearance = self.recent = appearance
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
    def usual_length(self) -> float:
        """Longer side, px, by the believable boxes; before there is one by the filter."""
        return max(self.pose.length or self.filter.length, 1.0)

    @property
    def plausible(self) -> bool:
        """Whether its poses leave it to be a person."""
        return self.pose.plausible_ns is not None

    @property
    def nobody(self) -> bool:
        """Whether it is clutter that was taken for a person; poses of somebody in bad light are nearly believable."""
        nearly = self.pose.judged * (CONFIRM_CONFIDENCE - self.pose.mean) <= _NOBODY
        return not (self.pose.established or self.plausible or nearly)

    @property
    def moves(self) -> bool:
        """Whether it was certainly a person once, or may be one: what is none stays in its place."""
        return self.plausible or self.pose.believed_ns is not None

    def sought_box(self, stamp_ns: int) -> np.ndarray:
        """(4,) px around the place where the whole person may be after a gap: the last box showed a part, curled up."""
        box = self.filter.box_at(stamp_ns)
        reach = max(self.filter.length, self.pose.length) * (0.5 + _SPEED * self.undetected_s(stamp_ns))
        centre = (box[:2] + box[2:]) / 2
        return np.concatenate([np.minimum(box[:2], centre - reach), np.maximum(box[2:], centre + reach)])

    def correct(self, box: np.ndarray, score: float) -> None:
        """Take another detection of this image in place of the last one."""
        self.filter.remeasure(box, 1.0)
        self.box, self.score = np.asarray(box, float), score

    def searched(self, found: bool) -> None:
        """Count an image in which it was sought at its place."""
        self.rate = float(np.clip(self.rate + _SEEN_RATE * (found - self.rate), *_RATES))

    def update(self, box: np.ndarray, score: float, stamp_ns: int) -> None:
        """Update with a detection, not yet confirmed."""
        self.filter.update(box)
        self.box = np.asarray(box, float)
        self.detected_ns = stamp_ns
        self.score = score
        self.mean_score += _RECENT_RATE * (score - self.mean_score)
        self.hits += 1

    def measure(self, box: np.ndarray, stamp_ns: int) -> None:
        """Confirm the person in the box (4,) px around its joints, in place of a detection of this image."""
        if self.detected_ns == stamp_ns:
            self.correct(box, self.score)
        else:
            self.filter.predict(stamp_ns)
            self.update(box, self.score, stamp_ns)
        self.confirm(stamp_ns)

    def remainder(self, stamp_ns: int) -> Person:
        """A track of what its box shows, which was found to be no person."""
        clutter = Person(self.box, self.score, stamp_ns, None)
        clutter.pose.refute(self.pose.value, stamp_ns)
        return clutter

    def move_camera(self, matrix: np.ndarray) -> None:
        """Follow the image's motion (2, 3) by the camera's."""
        self.filter.move_camera(matrix)
        self.box, self.pose.began = moved_box(matrix, self.box), moved_box(matrix, self.pose.began)
        if self.pose.box is not None:
            self.pose.box = moved_box(matrix, self.pose.box)
        if self.joints is not None:
            self.joints.move_camera(matrix)

    def continue_as(self, lost: Person) -> None:
        """Take over what is known of a lost person who was found again in this track."""
        if lost.appearance is not None:
            self.appearance, self._descriptors = lost.appearance, lost._descriptors
        self.others |= lost.others
        if self.joints is not None and lost.joints is not None:
            self.joints.keep_look(lost.joints)

    def confirm(self, stamp_ns: int) -> None:
        """Confirm the detection at this time."""
        self.detected_ns = self.confirmed_ns = stamp_ns

    def update_appearance(self, appearance: np.ndarray | None, lasting: bool = True) -> None:
        """Blend a descriptor into the recent appearance, and the ``lasting`` one, with larger weights at first."""
        if appearance is None:
            return
        self.recent = _blend(self.recent, appearance, _RECENT_RATE)
        if lasting or not self.appearance_settled:
            self._descriptors += 1
            self.appearance = _blend(self.appearance, appearance, max(SLOW_RATE, 1 / self._descriptors))

    @property
    def appearance_settled(self) -> bool:
        """Whether the appearance is a mean over enough images."""
        return self._descriptors * SLOW_RATE >= 1.0

    def similarity(self, appearance: np.ndarray | None) -> float:
        """Bhattacharyya coefficient with a descriptor in [0, 1]; 0.5 when one is unknown."""
        return 0.5 if self.appearance is None or appearance is None else float(self.appearance @ appearance)


def _blend(mean: np.ndarray | None, appearance: np.ndarray, rate: float) -> np.ndarray:
    """The squares are the histograms; a blend of these keeps their sum."""
    return appearance if mean is None else np.asarray(np.sqrt((1 - rate) * mean**2 + rate * appearance**2))


def person_at(box: np.ndarray, persons: Iterable[Person], stamp_ns: int) -> Person | None:
    """Who was detected in this image where a box (4,) px is, or inside one that somebody has drawn loosely."""
    detected = [p for p in persons if p.detected_ns == stamp_ns]
    given, boxes = box[None].astype(float), boxes_of(detected)
    overlap = iou(given, boxes)[0]
    inside = (overlap_coefficient(given, boxes)[0] > _INSIDE) & (areas_of(boxes) < areas_of(given))
    overlap[(overlap < PARTLY) & ~(inside & (overlap > TOUCHES))] = 0.0
    return detected[int(overlap.argmax())] if overlap.max(initial=0.0) > 0 else None


def boxes_of(persons: Iterable[Person]) -> np.ndarray:
    """(N, 4) px, last boxes."""
    return np.array([p.box for p in persons]).reshape(-1, 4)
