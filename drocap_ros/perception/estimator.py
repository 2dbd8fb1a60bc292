"""From an image to the subject's keypoints: detection, subject, 2D pose, uncertainty, our joints."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.joint_maps import joint_map
from drocap_ros.observation import PoseObservation
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import suppress, whole
from drocap_ros.perception.flow import KeypointFlow
from drocap_ros.perception.load_models import limited_use, load_detector, load_pose_model
from drocap_ros.perception.perception_config import PoseEstimatorConfig
from drocap_ros.perception.pose import Keypoints
from drocap_ros.perception.tracking import Subject, SubjectTracker
from drocap_ros.perception.tracking.search import Window, inside
from drocap_ros.perception.uncertainty import calibrate
from drocap_ros.skeleton import BODY_15

#: A predicted or doubtful box is confirmed when the mean confidence of its joints reaches this: on boxes without
#: a person it stays below 0.33, on persons in bad light it is 0.5 to 0.9.
_CONFIRM_CONFIDENCE = 0.5
#: Detector's score and mean confidence of the joints from which the next images need no detection.
_STEADY_SCORE, _STEADY_CONFIDENCE = 0.6, 0.8
#: A detection is due a little before its time: stamps are never even.
_SLACK_S = 0.005
#: In a hurry, share of the detector's input that a window of the image is given.
_QUICK = 0.8
#: In a hurry, most times as many images without a look at the joints as after the first in vain: at 30 Hz 0.4 s.
_LONGEST_PAUSE = 4
#: Confidence of a joint that helps to place the box.
_FINE_JOINT = 0.3


log = logging.getLogger(__name__)


class PoseEstimator:
    """Follows one person through the images of one camera; the same images give the same results.

    Parameters
    ----------
    models_dir : folder with a person detector and a 2D pose model (``.onnx``)
    config : models, thresholds, choice of the subject

    Raises
    ------
    InputError
        When a model is missing or cannot be used.
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig | None = None) -> None:
        self.config = config or PoseEstimatorConfig()
        self.pose_model = load_pose_model(models_dir, self.config)
        self.detector = load_detector(models_dir, self.config)
        #: In words, when a network is not meant for pictures of real people; else empty.
        self.limited_use = limited_use(self.pose_model.model) or limited_use(self.detector.model)
        if self.limited_use:
            log.warning("networks in use: %s", self.limited_use)
        self.tracker = SubjectTracker(self.config)
        self._map = joint_map(self.pose_model.joints.name)
        self._last_ns: int | None = None
        self._margins: np.ndarray | None = None
        self._detected_ns = 0
        self._searched_ns = 0
        self._clear = False
        self._shown = False
        #: Whether the keypoints of the last image that a network saw are likely the subject's.
        self._certain = False
        #: How often in a row the joints were looked for in vain, and the images since then.
        self._in_vain = self._not_looked = 0
        self._flow = KeypointFlow()
        #: The pose network's own keypoints of the last image, with further candidate peaks; None without a subject.
        self.keypoints: Keypoints | None = None

    def process(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None = None, hurry: int = 0
    ) -> PoseObservation:
        """The subject in one image.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        stamp_ns : exposure time; one earlier than the last image's begins anew, with a warning
        roi : (4,) x_min y_min x_max y_max px: the drone's own box of the person it tracks, or a user's choice
        hurry : 0 = there is time.  Else the image has waited, and work is saved: after each image that the network has
            seen the keypoints of up to ``hurry`` others are carried on by optical flow; one window and no second look
            for a detection, and none at all for ``hurry * detect_every_s`` after one that showed the subject clearly;
            where the network saw no joints and the detector does not see the subject clearly, they are not looked for
            in the next ``hurry`` images, in twice and four times as many if they were not seen then either
        """
        image = _checked(image)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            log.warning("stamps went back by %.3f s: following anew", (self._last_ns - stamp_ns) * 1e-9)
            self.tracker.restart()
            self._flow.begin(None, None)
            self._margins = None
        self._last_ns = stamp_ns
        roi = _checked_roi(roi)
        self.keypoints = None
        observation = self._flow.carry(image, stamp_ns) if roi is None and self._flow.steps < hurry else None
        if observation is not None:
            self._in_vain = 0
            return observation
        if roi is None:
            observation = self._carry(image, stamp_ns) or (self._glance(image, stamp_ns, hurry) if hurry else None)
        if observation is None:
            observation = self._search(image, stamp_ns, roi, hurry)
        # What may be no person at all is not carried on: it is looked for anew.
        self._flow.begin(image if hurry and self._certain else None, observation)
        return observation

    def _search(self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None, hurry: int) -> PoseObservation:
        """The subject by detection, and its joints."""
        size = (image.shape[1], image.shape[0])
        self._searched_ns, self._clear = stamp_ns, False
        found = self._detect(image, stamp_ns, hurry > 0)
        subject = self.tracker.update(image, stamp_ns, found.boxes, found.scores, roi)
        self._shown = subject is not None and subject.score >= _STEADY_SCORE
        if subject is None:
            self._in_vain = 0
            return PoseObservation(stamp_ns, 0, size)
        if subject.hidden:
            return _unseen(stamp_ns, size, subject)
        pause = hurry * min(2 ** (self._in_vain - 1), _LONGEST_PAUSE) if self._in_vain else 0
        if subject.score < _STEADY_SCORE and self._not_looked < pause:
            self._not_looked += 1
            return _unseen(stamp_ns, size, subject)
        self.keypoints = self.pose_model.estimate(image, subject.box)
        pose = self._in_our_joints(self.keypoints)
        self._clear = bool(pose[2].mean() >= _STEADY_CONFIDENCE)
        self._in_vain = self._in_vain + 1 if pose[2].mean() < _CONFIRM_CONFIDENCE else 0
        self._not_looked = 0
        self._certain = not self._in_vain or subject.score >= self.config.detection_threshold
        self._margins = None
        seen = _extent(pose)
        if subject.score < self.config.detection_threshold:
            if seen is not None and pose[2].mean() >= _CONFIRM_CONFIDENCE:
                margin = 0.06 * (seen[2:] - seen[:2]).max()
                self.tracker.confirm(seen + margin * np.array([-1, -1, 1, 1]), stamp_ns)
        elif seen is not None and subject.score >= _STEADY_SCORE and self._clear:
            self._margins = (subject.box - seen) / (seen[2:] - seen[:2]).max()
            self._detected_ns = stamp_ns
        return self._observation(stamp_ns, size, subject, pose)

    @property
    def carried(self) -> bool:
        """Whether the last image's keypoints are those of the one before, carried on."""
        return self._flow.steps > 0

    def _carry(self, image: np.ndarray, stamp_ns: int) -> PoseObservation | None:
        """The subject without detection: where it stands alone and the pose network sees it clearly, or None.

        The box is then that of the joints, with the margins that the last detection had around them.
        """
        if self._margins is None or (stamp_ns - self._detected_ns) * 1e-9 > self.config.detect_every_s - _SLACK_S:
            return None
        predicted = self.tracker.steady((image.shape[1], image.shape[0]), stamp_ns)
        if predicted is None:
            return None
        keypoints = self.pose_model.estimate(image, predicted.box)
        pose = self._in_our_joints(keypoints)
        seen = _extent(pose)
        if seen is None or pose[2].mean() < _STEADY_CONFIDENCE:
            return None
        box = seen + self._margins * (seen[2:] - seen[:2]).max()
        box = np.clip(box, 0, np.array([image.shape[1], image.shape[0]] * 2, float))
        self.tracker.carry(box, stamp_ns)
        self._certain = True
        self.keypoints = keypoints
        subject = Subject(predicted.track_id, box, predicted.score, False)
        return self._observation(stamp_ns, (image.shape[1], image.shape[0]), subject, pose)

    def _glance(self, image: np.ndarray, stamp_ns: int, hurry: int) -> PoseObservation | None:
        """The subject where it is predicted, without detection; None when that is due or the last image was not clear.

        The tracker learns nothing from it: in a crowd the joints may be another's, and the next detection decides.
        """
        predicted = self.tracker.in_view(stamp_ns) if self._clear else None
        due_s = hurry * self.config.detect_every_s
        if predicted is None or (stamp_ns - self._searched_ns) * 1e-9 > due_s - _SLACK_S:
            return None
        self.keypoints = self.pose_model.estimate(image, predicted.box)
        pose = self._in_our_joints(self.keypoints)
        self._clear = bool(pose[2].mean() >= _STEADY_CONFIDENCE)
        self._certain = bool(pose[2].mean() >= _CONFIRM_CONFIDENCE)
        return self._observation(stamp_ns, (image.shape[1], image.shape[0]), predicted, pose)

    def _observation(
        self, stamp_ns: int, size: tuple[int, int], subject: Subject, pose: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> PoseObservation:
        xy, covariance, confidence = pose
        outside = ~((xy >= 0) & (xy < np.array(size))).all(axis=1)  # networks guess beyond the picture: nobody saw that
        confidence = np.where(outside, 0.0, confidence)
        unseen = outside | (confidence < self.config.keypoint_threshold)
        xy[unseen], covariance[unseen] = np.nan, np.nan
        return PoseObservation(
            stamp_ns, subject.track_id, size, BODY_15, subject.box.astype(np.float32), subject.score,
            xy.astype(np.float32), covariance.astype(np.float32), confidence.astype(np.float32),
        )  # fmt: skip

    def _detect(self, image: np.ndarray, stamp_ns: int, hurried: bool) -> Detections:
        """Detections of all windows together, one per person."""
        size = (image.shape[1], image.shape[0])
        found = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32))
        for window in self.tracker.windows(size, stamp_ns, one=hurried, quick=hurried and self._shown):
            found = self._merged(found, self._look(image, window, hurried))
        closer = None if hurried else self.tracker.second_look(size, stamp_ns, found.boxes, found.scores)
        if closer is not None:
            found = self._merged(found, self._look(image, closer))
        kept = whole(found.boxes, found.scores)
        return Detections(found.boxes[kept], found.scores[kept])

    def _look(self, image: np.ndarray, window: Window | None, hurried: bool = False) -> Detections:
        """Detections in a window, without those that its edge cuts."""
        size = (image.shape[1], image.shape[0])
        quick = None if not hurried else 1.0 if window is None else _QUICK
        found = self.detector.detect(image, window, self.config.low_threshold, quick)
        uncut = inside(found.boxes, window, size)
        return Detections(found.boxes[uncut], found.scores[uncut])

    def _merged(self, a: Detections, b: Detections) -> Detections:
        if not len(a) or not len(b):
            return b if len(b) else a
        boxes, scores = np.concatenate([a.boxes, b.boxes]), np.concatenate([a.scores, b.scores])
        kept = suppress(boxes, scores, self.config.nms_iou)
        return Detections(boxes[kept], scores[kept])

    def _in_our_joints(self, keypoints: Keypoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        covariance, confidence = calibrate(keypoints, self.pose_model.spec.layout)
        return self._map.apply(keypoints.xy.astype(float), covariance, confidence, keypoints.box_size)


def _extent(pose: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray | None:
    """(4,) px box of the joints, None when too few of them are seen."""
    xy, _, confidence = pose
    fine = confidence >= _FINE_JOINT
    if fine.sum() < 0.7 * len(fine):
        return None
    return np.concatenate([xy[fine].min(axis=0), xy[fine].max(axis=0)])


def _unseen(stamp_ns: int, size: tuple[int, int], subject: Subject) -> PoseObservation:
    """The subject where it is predicted, none of its joints seen."""
    count = len(BODY_15)
    return PoseObservation(
        stamp_ns, subject.track_id, size, BODY_15, subject.box.astype(np.float32), 0.0,
        np.full((count, 2), np.nan, np.float32), np.full((count, 3), np.nan, np.float32), np.zeros(count, np.float32),
    )  # fmt: skip


def _checked(image: np.ndarray) -> np.ndarray:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise InputError(f"image: expected (H, W, 3) uint8 BGR, got {image.dtype} {image.shape}; convert it")
    return image


def _checked_roi(roi: np.ndarray | None) -> np.ndarray | None:
    """A usable roi; an empty one says, as in ROS, that there is none."""
    if roi is None:
        return None
    roi = np.asarray(roi, float)
    if roi.shape != (4,) or not np.isfinite(roi).all():
        raise InputError(f"roi: expected x_min y_min x_max y_max px, got {roi.tolist()}; correct its sender")
    return None if (roi[2:] <= roi[:2]).any() else roi
