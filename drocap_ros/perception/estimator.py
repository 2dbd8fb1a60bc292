"""From an image to the subject's keypoints: detection, subject, 2D pose, uncertainty, our joints."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.config import PoseEstimatorConfig
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import suppress, whole
from drocap_ros.perception.joint_maps import joint_map
from drocap_ros.perception.models import load_detector, load_pose_model
from drocap_ros.perception.observation import PoseObservation
from drocap_ros.perception.pose import Keypoints
from drocap_ros.perception.tracking import Subject, SubjectTracker
from drocap_ros.perception.tracking.search import Window, inside
from drocap_ros.perception.uncertainty import calibrate
from drocap_ros.skeleton import BODY_15

#: A predicted or doubtful box is confirmed when the mean confidence of its joints reaches this: on boxes without
#: a person it stays below 0.33, on persons in bad light it is 0.5 to 0.9.
_CONFIRM_CONFIDENCE = 0.5
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
        self.tracker = SubjectTracker(self.config)
        self._map = joint_map(self.pose_model.joints.name)
        self._last_ns: int | None = None
        #: The pose network's own keypoints of the last image, with further candidate peaks; None without a subject.
        self.keypoints: Keypoints | None = None

    def process(self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None = None) -> PoseObservation:
        """The subject in one image.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        stamp_ns : exposure time; one earlier than the last image's begins anew, with a warning
        roi : (4,) x_min y_min x_max y_max px: the drone's own box of the person it tracks, or a user's choice
        """
        image = _checked(image)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            log.warning("stamps went back by %.3f s: following anew", (self._last_ns - stamp_ns) * 1e-9)
            self.tracker.restart()
        self._last_ns = stamp_ns
        size = (image.shape[1], image.shape[0])
        found = self._detect(image, stamp_ns)
        subject = self.tracker.update(image, stamp_ns, found.boxes, found.scores, _checked_roi(roi))
        self.keypoints = None
        if subject is None:
            return PoseObservation(stamp_ns, 0, size)
        if subject.hidden:
            return _unseen(stamp_ns, size, subject)
        self.keypoints = self.pose_model.estimate(image, subject.box)
        xy, covariance, confidence = self._in_our_joints(self.keypoints)
        if subject.score < self.config.detection_threshold:
            self._confirm(xy, confidence, stamp_ns)
        unseen = confidence < self.config.keypoint_threshold
        xy[unseen], covariance[unseen] = np.nan, np.nan
        return PoseObservation(
            stamp_ns, subject.track_id, size, BODY_15, subject.box.astype(np.float32), subject.score,
            xy.astype(np.float32), covariance.astype(np.float32), confidence.astype(np.float32),
        )  # fmt: skip

    def _detect(self, image: np.ndarray, stamp_ns: int) -> Detections:
        """Detections of all windows together, one per person."""
        size = (image.shape[1], image.shape[0])
        found = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32))
        for window in self.tracker.windows(size, stamp_ns):
            found = self._merged(found, self._look(image, window))
        closer = self.tracker.second_look(size, stamp_ns, found.boxes, found.scores)
        if closer is not None:
            found = self._merged(found, self._look(image, closer))
        kept = whole(found.boxes, found.scores)
        return Detections(found.boxes[kept], found.scores[kept])

    def _look(self, image: np.ndarray, window: Window | None) -> Detections:
        """Detections in a window, without those that its edge cuts."""
        found = self.detector.detect(image, window, self.config.low_threshold)
        uncut = inside(found.boxes, window, (image.shape[1], image.shape[0]))
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

    def _confirm(self, xy: np.ndarray, confidence: np.ndarray, stamp_ns: int) -> None:
        """Tell the tracker where the subject is when the pose network sees a whole person in the predicted box."""
        fine = confidence >= _FINE_JOINT
        if confidence.mean() < _CONFIRM_CONFIDENCE or fine.sum() < 0.7 * len(fine):
            return
        low, high = np.nanmin(xy[fine], axis=0), np.nanmax(xy[fine], axis=0)
        margin = 0.06 * (high - low).max()
        self.tracker.confirm(np.concatenate([low - margin, high + margin]), stamp_ns)


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
    if roi is None:
        return None
    roi = np.asarray(roi, float)
    if roi.shape != (4,) or not np.isfinite(roi).all() or (roi[2:] <= roi[:2]).any():
        raise InputError(f"roi: expected x_min y_min x_max y_max px, got {roi.tolist()}; correct its sender")
    return roi
