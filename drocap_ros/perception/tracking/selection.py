"""Choice of a subject by the configured rule."""

from __future__ import annotations

import numpy as np

from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.person import Person

#: Score from which the first person ever needs no confirmation by further images.
_CERTAIN_SCORE = 0.6


def select(
    persons: list[Person],
    lost: Person | None,
    config: PoseEstimatorConfig,
    shape: tuple[int, ...],
    stamp_ns: int,
    first: bool,
    nothing_yet: bool,
) -> Person | None:
    """The person detected in this image who becomes the subject, or None.

    Parameters
    ----------
    lost : the last subject
    config : the rule; after a given box or the drone's the largest person follows
    shape : of the image
    first : whether there was no subject yet; then a person whose poses are not believable can be chosen
    nothing_yet : whether no image before had a detection
    """
    candidates = [
        p
        for p in persons
        if p.detected_ns == stamp_ns
        and p is not lost
        and (p.plausible or first)
        and p.score >= config.detection_threshold
        and (p.hits >= config.confirm_frames or (nothing_yet and p.score >= _CERTAIN_SCORE))
    ]
    if config.subject == "centre":
        middle = np.array([shape[1], shape[0]]) / 2
        return min(candidates, key=lambda p: float(np.linalg.norm((p.box[:2] + p.box[2:]) / 2 - middle)), default=None)
    return max(candidates, key=lambda p: float(np.prod(p.box[2:] - p.box[:2])), default=None)
