"""The choice of the next subject: by a given box, or by a rule among those in view."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import overlap_coefficient
from drocap_ros.perception.tracking.appearance import describe
from drocap_ros.perception.tracking.association import certainly_others
from drocap_ros.perception.tracking.person import DOUBT_S, SURE_CONFIDENCE, Person, person_at
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig, parse_box

CERTAIN_SCORE = 0.6  # from which the first person ever, and one with a clear pose, needs no further images
_CLEARER = 0.1  # excess of the poses' mean confidence over time, s, from which another choice is better
_BELIEF = 4.0  # logarithm of the size that full belief in the pose outweighs: a shadow is no smaller than the person


class SubjectChoice:
    """Chooses the next subject, of persons tracked in one image."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._config = config
        #: (4,) px, given and not yet used.
        self.box: np.ndarray | None = parse_box(config.subject_box) if config.subject == "box" else None
        #: Whether no image before had a detection.
        self.nothing_yet = True
        #: Whether poses judge the persons: then whoever has none yet waits.
        self.by_poses = False
        #: Who was chosen by the rule last, when, and the last image in which it was compared with those beside it.
        self._chosen: tuple[Person | None, int, int] = None, 0, 0
        #: By how much their poses are clearer, over time, s.
        self._lead: dict[Person, float] = {}

    def given(self, image: np.ndarray, persons: list[Person], stamp_ns: int) -> Person | None:
        """The person in the given box, a new one where none is detected; None without a box."""
        if self.box is None:
            return None
        box, self.box = self.box, None
        return person_at(box, persons, stamp_ns) or Person(box, 0.0, stamp_ns, describe(image, box))

    def by_rule(
        self,
        persons: list[Person],
        last: Person | None,
        shape: tuple[int, ...],
        stamp_ns: int,
        coast_s: float,
        first: bool,
    ) -> Person | None:
        """The person detected in this image who becomes the subject; None while there is one to wait for.

        last : the last subject, predicted over ``coast_s``; shape : of the image
        first : whether there was no subject yet; then a person whose poses are not believable can be chosen
        """
        waits = self._waits(last, stamp_ns, coast_s, first)
        if waits and (last is None or not last.nobody):
            return self._beside(last, persons, stamp_ns)
        if waits:  # whoever certainly is a person does not wait for clutter
            persons = [p for p in persons if p.pose.established]
        elif last is not None and not last.left_image:
            persons = certainly_others(last, persons, stamp_ns)
        persons = [p for p in persons if p is not last and p.detected_ns == stamp_ns]
        # One who is about to be confirmed is waited for.
        persons = [p for p in persons if self._confirmed(p, first) or (p.plausible and p.hits > 1)]
        best = max(persons, key=lambda p: self._rank(p, shape), default=None)
        if best is None or not self._confirmed(best, first):
            return None
        self._chosen, self._lead = (best, stamp_ns, stamp_ns), {}
        return best

    def is_open(self, subject: Person, stamp_ns: int) -> bool:
        """Whether the rule chose the subject a moment ago, and may choose better: a shadow lies at somebody's feet."""
        return subject is self._chosen[0] and stamp_ns - self._chosen[1] <= 1e9 * DOUBT_S

    def _beside(self, last: Person | None, persons: list[Person], stamp_ns: int) -> Person | None:
        """Whom of those beside the subject the rule would rather have chosen, by the belief in all poses."""
        if last is None or not self.is_open(last, stamp_ns):
            return None
        subject, chosen_ns, looked_ns = self._chosen
        self._chosen = subject, chosen_ns, stamp_ns
        here = [p for p in persons if p is not last and p.plausible and p.detected_ns == stamp_ns]
        here = [p for p in here if p.first_ns <= chosen_ns and p.pose.judged >= self._config.confirm_frames]
        here = [p for p in here if overlap_coefficient(p.box[None], last.box[None])[0, 0] > 0]
        for p in here:
            lead = p.pose.mean - last.pose.mean
            self._lead[p] = max(self._lead.get(p, 0.0) + lead * (stamp_ns - looked_ns) * 1e-9, 0.0)
        best = max(here, key=self._lead.__getitem__, default=None)
        return best if best is not None and self._lead[best] > _CLEARER else None

    def _rank(self, person: Person, shape: tuple[int, ...]) -> float:
        """The highest is chosen: by the size or the distance from the middle, and the belief in the pose."""
        belief = _BELIEF * (0.0 if np.isnan(person.pose.value) else person.pose.value)
        if self._config.subject == "centre":
            off = (person.box[:2] + person.box[2:]) / 2 - np.array([shape[1], shape[0]]) / 2
            return belief - float(np.linalg.norm(off)) / person.filter.length
        # After a given box or the drone's the largest person follows.
        return belief + float(np.log(np.prod(person.box[2:] - person.box[:2])))

    def _waits(self, last: Person | None, stamp_ns: int, coast_s: float, first: bool) -> bool:
        """Whether a box is to come that chooses, or the last subject may come back."""
        waits = self._config.on_loss == "wait"
        if last is None:
            return self._config.subject in ("box", "roi") and (first or waits)
        # Whoever was followed for a moment is not waited for much longer.
        followed_s = (last.confirmed_ns - last.first_ns) * 1e-9
        longest_s = 0.0 if last.left_image else coast_s + min(DOUBT_S, followed_s)
        return (waits and last.pose.established) or last.unconfirmed_s(stamp_ns) <= longest_s

    def _confirmed(self, person: Person, first: bool) -> bool:
        """Whether enough images show the person; at the beginning a certain detection is enough."""
        possible = person.plausible or (first and person.mean_score >= CERTAIN_SCORE)
        unjudged = self.by_poses and np.isnan(person.pose.value)
        if not possible or unjudged or person.mean_score < self._config.detection_threshold:
            return False
        certain = person.score >= CERTAIN_SCORE and not person.pose.value < SURE_CONFIDENCE
        return person.hits >= self._config.confirm_frames or (self.nothing_yet and certain)
