"""Search for the subject: the windows of an image in which the detector runs."""

from __future__ import annotations

from functools import reduce

import numpy as np

from drocap_ros.perception.detection.detector import Detections, Detector
from drocap_ros.perception.detection.nms import iou, overlap_coefficient, suppress
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.detection_windows import (
    CLOSE,
    TIGHT,
    WIDE,
    Window,
    WindowSchedule,
    uncut,
    window_around,
)
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.reidentification import search_boxes
from drocap_ros.perception.tracking.subject import SubjectTracker

#: Least overlap of a detection with the predicted box that needs no second pass.
_CLEAR_IOU = 0.5
#: Overlap with the predicted box from which a detection may be the subject.
_AT_PLACE = 0.3
#: Free margin around an isolated subject, lengths.
_ISOLATED = 0.4
#: Under load shedding, share of the detector's input for a window.
_REDUCED_INPUT = 0.8


class SubjectSearch:
    """Runs the detector where the tracker expects the subject, and at intervals in the whole image."""

    def __init__(self, detector: Detector, tracker: SubjectTracker, config: PoseEstimatorConfig) -> None:
        self._detector, self._tracker, self._config = detector, tracker, config
        self._schedule = WindowSchedule()

    def detect(self, image: np.ndarray, stamp_ns: int, shedding: bool, close: bool) -> Detections:
        """Detections of all windows together, parts of persons among them.

        shedding : one window, a larger one where the last image did not show the subject
        close : a smaller window around the subject
        """
        size = (image.shape[1], image.shape[0])
        windows = self.windows(size, stamp_ns, shedding, close)
        found = reduce(_merged, [self._detect_in(image, window, shedding) for window in windows])
        if shedding or (subject := self._tracker.followed(stamp_ns)) is None:
            return found
        for further in (self.second_pass_window, self.sought_window):
            if (window := further(subject, found, size, stamp_ns)) is not None:
                found = _merged(found, self._detect_in(image, window, False))
        return found

    def isolated(self, predicted: np.ndarray, image_size: tuple[int, int], stamp_ns: int) -> bool:
        """Whether a subject at this box (4,) px is away from others and from the edges, and no full image is due."""
        subject = self._tracker.subject
        if subject is None or self._schedule.full_image_due(stamp_ns):
            return False
        around = predicted + _ISOLATED * subject.filter.length * np.array([-1, -1, 1, 1])
        others = [p.filter.box_at(stamp_ns) for p in self._tracker.persons if p is not subject and p.reliable]
        edge = 0.01 * max(image_size)
        at_edge = (predicted[:2] < edge).any() or (predicted[2:] > np.array(image_size) - edge).any()
        return not ((overlap_coefficient(around[None], np.array(others).reshape(-1, 4)) > 0).any() or at_edge)

    def windows(self, image_size: tuple[int, int], stamp_ns: int, single: bool, close: bool) -> list[Window | None]:
        """Windows of the next image, with ``single`` one; None = the whole image; ``close`` as for :meth:`detect`."""
        tracker = self._tracker
        if tracker.choice.box is not None:
            near = window_around(tracker.choice.box, image_size, WIDE)
            return [near] if single else list({near: None, None: None})
        subject = tracker.followed(stamp_ns)
        if subject is None:
            boxes = search_boxes(tracker.subject, tracker.persons, self._config.confirm_frames, stamp_ns)
            return self._schedule.search(boxes, image_size, stamp_ns, single)
        box = subject.filter.box_at(stamp_ns)
        if single and tracker.missed:
            box, close = subject.sought_box(stamp_ns), False
        near = window_around(box, image_size, CLOSE if close else WIDE)
        windows = [near]
        if near is None or self._schedule.full_image_due(stamp_ns):
            self._schedule.full_ns = stamp_ns
            windows = [None] if single else list({near: None, None: None})
        if subject.pose.questioned and windows != [None]:  # whoever it is: the search goes on beside it
            windows += [w for w in self._schedule.search([], image_size, stamp_ns, True) if w not in windows]
        return windows[-1:] if single else windows

    def second_pass_window(
        self, subject: Person, found: Detections, image_size: tuple[int, int], stamp_ns: int
    ) -> Window | None:
        """Tight window around a subject that the detections do not show clearly, or None."""
        box = subject.filter.box_at(stamp_ns)
        clear = found.boxes[found.scores >= self._config.detection_threshold]
        return None if _overlaps(box, clear, _CLEAR_IOU) else window_around(box, image_size, TIGHT)

    def sought_window(
        self, subject: Person, found: Detections, image_size: tuple[int, int], stamp_ns: int
    ) -> Window | None:
        """Window in which a subject that the last image did not show may be, if it is in none of the boxes; or None."""
        at_place = _overlaps(subject.filter.box_at(stamp_ns), found.boxes, _AT_PLACE)
        if at_place or not self._tracker.missed:
            return None
        return window_around(subject.sought_box(stamp_ns), image_size, WIDE)

    def _detect_in(self, image: np.ndarray, window: Window | None, shedding: bool) -> Detections:
        """Detections in a window, without those that its edge cuts."""
        reduced = None if not shedding else 1.0 if window is None else _REDUCED_INPUT
        found = self._detector.detect(image, window, self._config.low_threshold, reduced)
        kept = uncut(found.boxes, window, (image.shape[1], image.shape[0]))
        return Detections(found.boxes[kept], found.scores[kept])


def _overlaps(box: np.ndarray, boxes: np.ndarray, least: float) -> bool:
    return bool((iou(box[None], boxes.astype(float)) > least).any())


def _merged(a: Detections, b: Detections) -> Detections:
    if not len(a) or not len(b):
        return b if len(b) else a
    boxes, scores = np.concatenate([a.boxes, b.boxes]), np.concatenate([a.scores, b.scores])
    kept = suppress(boxes, scores)
    return Detections(boxes[kept], scores[kept])
