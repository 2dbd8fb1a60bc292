"""Search for the subject: the windows of an image in which the detector runs."""

from __future__ import annotations

from concurrent.futures import Executor, Future
from functools import reduce

import numpy as np

from drocap_ros.perception.detection.detector import Detections, Detector
from drocap_ros.perception.detection.nms import MOSTLY, PARTLY, iou, overlap_coefficient, suppress
from drocap_ros.perception.tracking.association import FORGET_S, could_be
from drocap_ros.perception.tracking.person import Person
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.subject import EDGE, SubjectTracker

Window = tuple[int, int, int, int]

#: Side of a window over the subject's longer side, and its least side in px.  In bad light, detectors of 320-416 px
#: input give a person over most of the window two to three times the score of one over a third of it.  This one also
#: covers the persons nearby;
WIDE = (1.8, 416)
#: here a person is as large at 256 px of input as in WIDE at 320 px;
CLOSE = (1.45, 208)
#: and this one is for a low score.
TIGHT = (1.3, 160)
_TILE_PX = 800  # images longer than 1.25 of this are also searched in tiles of this side, one per image
FULL_EVERY_NS = 1_000_000_000  # interval of detection over the whole image while the subject is in view
SEARCH_EVERY_NS = 300_000_000  # without one, interval of a bystander's poses, and longest gap of one to look at closely
_ISOLATED = 0.4  # free margin around an isolated subject, lengths
_REDUCED_INPUT = 0.8  # under load shedding, share of the detector's input for a window
_WIDER_PER_S = 0.5  # growth of the search around the last place of a lost subject, lengths per second,
_WIDEST = 2.0  # and its farthest reach, lengths
_CUT_PX = 2.0  # distance from a window's edge below which a box is cut


class SubjectSearch:
    """Runs the detector where the tracker expects the subject, and at intervals in the whole image."""

    def __init__(self, detector: Detector, tracker: SubjectTracker, config: PoseEstimatorConfig) -> None:
        self._detector, self._tracker, self._config = detector, tracker, config
        self._full_ns: int | None = None  # last detection over the whole image
        self._tile = self._turn = 0
        self._alternate = False
        #: Whether the last image needed a second pass.
        self._unclear = False
        #: The next image, and detections in windows of it that another thread makes.
        self._begun: tuple[np.ndarray, dict[Window | None, Future[Detections]]] | None = None

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
        tight = self._second_pass_window(subject, found, size, stamp_ns)
        if tight is not None:
            found = _merged(found, self._detect_in(image, tight, False))
        self._unclear = tight is not None
        if (window := self.sought_window(subject, found, size, stamp_ns)) is not None:
            found = _merged(found, self._detect_in(image, window, False))
        return found

    def begin(self, image: np.ndarray, stamp_ns: int, beside: Executor) -> None:
        """Begin to detect in the next image, where the subject will be if its pose in this one changes nothing.

        It changes no result: :meth:`detect` searches the windows that were not begun.
        """
        subject = self._tracker.followed(stamp_ns)
        size = (image.shape[1], image.shape[0])
        windows: list[Window | None] = [None] if subject is None or self._full_image_due(stamp_ns) else []
        if subject is not None:
            box = subject.filter.box_at(stamp_ns)
            windows[:0] = [window_around(box, size, extent) for extent in (WIDE, TIGHT)[: 1 + self._unclear]]
        begun = {window: beside.submit(self._found_in, image, window, False) for window in dict.fromkeys(windows)}
        self._begun = image, begun

    def isolated(self, predicted: np.ndarray, image_size: tuple[int, int], stamp_ns: int) -> bool:
        """Whether a subject at this box (4,) px is away from others and from the edges, and no full image is due."""
        subject = self._tracker.subject
        if subject is None or self._full_image_due(stamp_ns):
            return False
        around = predicted + _ISOLATED * subject.filter.length * np.array([-1, -1, 1, 1])
        others = [p.filter.box_at(stamp_ns) for p in self._tracker.persons if p is not subject and p.plausible]
        edge = EDGE * max(image_size)
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
            return self._anywhere(self._likely_places(stamp_ns), image_size, stamp_ns, single)
        windows = self._around(subject, image_size, stamp_ns, single, close)
        if subject.pose.questioned and windows != [None]:  # whoever it is: the search goes on beside it
            windows += [w for w in self._anywhere([], image_size, stamp_ns, True) if w not in windows]
        return windows[-1:] if single else windows

    def _around(
        self, subject: Person, image_size: tuple[int, int], stamp_ns: int, single: bool, close: bool
    ) -> list[Window | None]:
        """Window around the subject, and at intervals the whole image."""
        box = subject.filter.box_at(stamp_ns)
        if single and self._tracker.missed:
            box, close = subject.sought_box(stamp_ns), False
        near = window_around(box, image_size, CLOSE if close else WIDE)
        if near is not None and not self._full_image_due(stamp_ns):
            return [near]
        self._full_ns = stamp_ns
        return [None] if single else list({near: None, None: None})

    def sought_window(
        self, subject: Person, found: Detections, image_size: tuple[int, int], stamp_ns: int
    ) -> Window | None:
        """Window in which a subject that the last image did not show may be, if it is in none of the boxes; or None."""
        if not self._tracker.missed or _overlaps(subject.filter.box_at(stamp_ns), found.boxes, PARTLY):
            return None
        return window_around(subject.sought_box(stamp_ns), image_size, WIDE)

    def _second_pass_window(
        self, subject: Person, found: Detections, image_size: tuple[int, int], stamp_ns: int
    ) -> Window | None:
        """Tight window around a subject that the detections do not show clearly, or None."""
        box = subject.filter.box_at(stamp_ns)
        clear = found.boxes[found.scores >= self._config.detection_threshold]
        return None if _overlaps(box, clear, MOSTLY) else window_around(box, image_size, TIGHT)

    def _full_image_due(self, stamp_ns: int) -> bool:
        return self._full_ns is None or stamp_ns - self._full_ns >= FULL_EVERY_NS

    def _anywhere(
        self, places: list[np.ndarray], image_size: tuple[int, int], stamp_ns: int, single: bool
    ) -> list[Window | None]:
        """Windows without a subject: the whole image, and in turn one around each box (4,) px of places, or a tile.

        With ``single`` whole image and others alternate.
        """
        self._full_ns = stamp_ns
        self._alternate = not self._alternate
        if single and not self._alternate:
            return [None]
        self._turn += 1
        tiled = tiles(image_size)
        turns: list[Window | None] = [window_around(box, image_size, WIDE) for box in places]
        at = self._turn % max(len(turns) + bool(tiled), 1)
        window = turns[at] if at < len(turns) else None
        if window is None and tiled:
            self._tile = (self._tile + 1) % len(tiled)
            window = tiled[self._tile]
        return [None] if window is None else [window] if single else [None, window]

    def _likely_places(self, stamp_ns: int) -> list[np.ndarray]:
        """(4,) px each, where to look closely without a subject: a possible new one, and around the last place."""
        lost, new = self._tracker.subject, self._possible_subject(stamp_ns)
        places = [] if new is None else [new.filter.box_at(stamp_ns)]
        if lost is not None and not lost.left_image and lost.unconfirmed_s(stamp_ns) <= FORGET_S:
            reach = min(_WIDER_PER_S * lost.unconfirmed_s(stamp_ns), _WIDEST) * lost.filter.length
            places.append(lost.box + reach * np.array([-1, -1, 1, 1]))
        return places

    def _possible_subject(self, stamp_ns: int) -> Person | None:
        """Who may become the subject: a small person needs a window around it to be confirmed."""
        lost = self._tracker.subject
        recent = [p for p in self._tracker.persons if p.plausible and stamp_ns - p.detected_ns <= SEARCH_EVERY_NS]
        if lost is not None:  # persons in view together with the subject cannot be the subject
            recent = [p for p in recent if p is not lost and could_be(lost, p)]
        return max(recent, key=lambda p: (p.hits < self._config.confirm_frames, p.mean_score), default=None)

    def _detect_in(self, image: np.ndarray, window: Window | None, shedding: bool) -> Detections:
        """Detections in a window, without those that its edge cuts; perhaps already begun."""
        if self._begun is not None and self._begun[0] is image and not shedding and window in self._begun[1]:
            return self._begun[1][window].result()
        return self._found_in(image, window, shedding)

    def _found_in(self, image: np.ndarray, window: Window | None, shedding: bool) -> Detections:
        reduced = None if not shedding else 1.0 if window is None else _REDUCED_INPUT
        found = self._detector.detect(image, window, self._config.low_threshold, reduced)
        kept = uncut(found.boxes, window, (image.shape[1], image.shape[0]))
        return Detections(found.boxes[kept], found.scores[kept])


def window_around(box: np.ndarray, image_size: tuple[int, int], extent: tuple[float, int]) -> Window | None:
    """Window of WIDE, CLOSE or TIGHT extent around a box (4,) px; None when it would be the whole image."""
    factor, least = extent
    width, height = image_size
    side = max(factor * float(max(box[2] - box[0], box[3] - box[1])), least)
    if side >= max(width, height):
        return None
    cx, cy = float(box[0] + box[2]) / 2, float(box[1] + box[3]) / 2
    w, h = int(min(side, width)), int(min(side, height))
    x0 = int(np.clip(cx - w / 2, 0, width - w))
    y0 = int(np.clip(cy - h / 2, 0, height - h))
    return x0, y0, x0 + w, y0 + h


def tiles(image_size: tuple[int, int]) -> list[Window]:
    """Overlapping tiles that cover a large image; none for an image that fits the detector."""
    width, height = image_size
    if max(width, height) <= 1.25 * _TILE_PX:
        return []
    side = max(_TILE_PX, max(width, height) // 6)

    def origins(length: int) -> list[int]:
        if length <= side:
            return [0]
        count = int(np.ceil((length - side) / (0.75 * side))) + 1
        return [round(i * (length - side) / (count - 1)) for i in range(count)]

    return [(x, y, min(x + side, width), min(y + side, height)) for y in origins(height) for x in origins(width)]


def uncut(boxes: np.ndarray, window: Window | None, image_size: tuple[int, int]) -> np.ndarray:
    """(N,) bool: boxes that no edge of the window cuts; edges of the image do not count."""
    if window is None:
        return np.ones(len(boxes), bool)
    low, high = np.array(window[:2]), np.array(window[2:])
    uncut_low = (boxes[:, :2] > low + _CUT_PX) | (low == 0)
    uncut_high = (boxes[:, 2:] < high - _CUT_PX) | (high == np.array(image_size))
    return np.asarray((uncut_low & uncut_high).all(axis=1))


def _overlaps(box: np.ndarray, boxes: np.ndarray, least: float) -> bool:
    return bool((iou(box[None], boxes.astype(float)) > least).any())


def _merged(a: Detections, b: Detections) -> Detections:
    if not len(a) or not len(b):
        return b if len(b) else a
    boxes, scores = np.concatenate([a.boxes, b.boxes]), np.concatenate([a.scores, b.scores])
    kept = suppress(boxes, scores)
    return Detections(boxes[kept], scores[kept])
