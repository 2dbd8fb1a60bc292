"""Choice of the subject: a given box, else the configured rule."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.detection.nms import iou
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig, parse_box
from drocap_ros.perception.tracking.person import Person, boxes_of
from drocap_ros.perception.tracking.reidentification import certainly_others

#: Score from which the first person ever needs no confirmation by further images.
_CERTAIN_SCORE = 0.6
#: Least overlap of a detection with a given box.
_GIVEN_IOU = 0.2
#: For ``on_loss = next``: time beyond coasting after which a subject lost inside the image is given up.
_GIVE_UP_S = 3.0


class SubjectChoice:
    """Chooses the next subject, of persons tracked in one image."""

    def __init__(self, config: PoseEstimatorConfig) -> None:
        self._config = config
        #: (4,) px, given and not yet used.
        self.box: np.ndarray | None = parse_box(config.subject_box) if config.subject == "box" else None
        #: Whether no image before had a detection.
        self.nothing_yet = True

    def given(self, persons: list[Person], stamp_ns: int) -> Person | None:
        """The person in the given box, a new one where none is detected; None without a box."""
        if self.box is None:
            return None
        box, self.box = self.box, None
        detected = [p for p in persons if p.detected_ns == stamp_ns]
        overlap = iou(box[None], boxes_of(detected))[0]
        if len(overlap) and overlap.max() >= _GIVEN_IOU:
            return detected[int(overlap.argmax())]
        return Person(box, 0.0, stamp_ns, None)

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
        config = self._config
        if config.subject in ("box", "roi") and (first or config.on_loss == "wait"):
            return None
        if last is not None:
            patience_s = 0.0 if last.left_image else coast_s + _GIVE_UP_S
            if config.on_loss == "wait" or last.unconfirmed_s(stamp_ns) <= patience_s:
                return None
            if not last.left_image:
                persons = certainly_others(last, persons, stamp_ns)
        candidates = [
            p
            for p in persons
            if p.detected_ns == stamp_ns
            and p is not last
            and (p.plausible or first)
            and p.score >= config.detection_threshold
            and (p.hits >= config.confirm_frames or (self.nothing_yet and p.score >= _CERTAIN_SCORE))
        ]
        if config.subject == "centre":
            middle = np.array([shape[1], shape[0]]) / 2
            return min(
                candidates, key=lambda p: float(np.linalg.norm((p.box[:2] + p.box[2:]) / 2 - middle)), default=None
            )
        # After a given box or the drone's the largest person follows.
        return max(candidates, key=lambda p: float(np.prod(p.box[2:] - p.box[:2])), default=None)
