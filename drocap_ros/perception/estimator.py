"""Pose estimator: image -> the subject's keypoints, by detection, tracking, 2D pose and calibration."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.joint_maps import joint_map
from drocap_ros.observation import PoseObservation
from drocap_ros.perception.body_pose import BodyPose
from drocap_ros.perception.detection.detector import Detections
from drocap_ros.perception.detection.nms import iou, suppress, without_parts
from drocap_ros.perception.flow import KeypointFlow
from drocap_ros.perception.load_models import limited_use, load_detector, load_pose_model
from drocap_ros.perception.pose import NetworkKeypoints
from drocap_ros.perception.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking import Subject, SubjectTracker
from drocap_ros.perception.tracking.camera_motion import CameraMotion, moved_box, sweeps
from drocap_ros.perception.tracking.detection_windows import Window, uncut
from drocap_ros.perception.tracking.pose_belief import CONFIRM_CONFIDENCE, EMPTY_CONFIDENCE
from drocap_ros.perception.tracking.rivals import wins
from drocap_ros.perception.tracking.shadow import without_shadow
from drocap_ros.perception.uncertainty import calibrate

#: Detection score and mean confidence from which the next images need no detection.
_CLEAR_SCORE, _CLEAR_CONFIDENCE = 0.6, 0.8
#: Tolerance of the detection interval against jitter of the stamps.
_SLACK_S = 0.005
#: Largest number of rivals of a doubtful subject whose poses one image looks at, and the same under load shedding.
_RIVALS, _FEW_RIVALS = 2, 1
#: Every so many rows tell whether an image is the last one again.
_COMPARED_ROWS = 4
#: Time for which a rival that lost is not looked at again, and the overlap from which a box is that rival's.
_REJECTED_NS, _SAME_IOU = 300_000_000, 0.6
#: Time without a detection and a believable pose after which there are no keypoints; a single blurred image is shorter.
_UNSEEN_NS = 80_000_000
#: Under load shedding, share of the detector's input for a window.
_REDUCED_INPUT = 0.8
#: Under load shedding, longest pause of the pose network, over the one after a first failure: 0.4 s at 30 Hz.
_LONGEST_PAUSE = 4

log = logging.getLogger(__name__)


class PoseEstimator:
    """Follows one person through the images of one camera; equal images give equal results.

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
        #: Notice of a network that is not for images of real people; else empty.
        self.limited_use = limited_use(self.pose_model.model) or limited_use(self.detector.model)
        if self.limited_use:
            log.warning("networks in use: %s", self.limited_use)
        self.tracker = SubjectTracker(self.config)
        self._joint_map = joint_map(self.pose_model.joints.name)
        self._flow = KeypointFlow()
        self._camera = CameraMotion()
        self._motion: np.ndarray | None = None
        self._last_ns: int | None = None
        #: Rows of the last image that certainly showed the subject, and the subject in it.
        self._repeated: tuple[np.ndarray, PoseObservation] | None = None
        #: Last run of the detector, and last image in which it, the pose or the optical flow showed the subject.
        self._detected_ns = self._seen_ns = 0
        #: Score of the subject in the last detection, and mean confidence of its last keypoints; 0 = none.
        self._score = self._confidence = 0.0
        #: (4,) margins of the last box around the joints, over the joints' longer extent; None unless both were clear.
        self._margins: np.ndarray | None = None
        #: Consecutive runs of the pose network without a person, and images without a run since the last one.
        self._failures = self._paused = 0
        #: Keypoints of the pose network in the last image; None where it did not run.
        self.keypoints: NetworkKeypoints | None = None
        #: Boxes (4,) px and stamps of the rivals that lost lately.
        self._rejected: list[tuple[np.ndarray, int]] = []

    def process(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None = None, load_level: int = 0
    ) -> PoseObservation:
        """The subject in one image.

        Parameters
        ----------
        image : (H, W, 3) uint8 BGR
        stamp_ns : exposure time; one earlier than the last image's resets the tracker, with a warning
        roi : (4,) x_min y_min x_max y_max px, box of the drone's own tracker, or a user's choice
        load_level : 0 = full work.  Above it: optical flow propagates the keypoints over up to ``load_level`` images
            after each run of the pose network; a detection has one window, no second pass, and after a clear pose
            an interval of ``load_level * detect_every_s``; after a run of the pose network without a person it pauses
            for ``load_level`` images, doubled at each further failure up to four times that, unless the detection is
            clear
        """
        _check_image(image)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            log.warning("stamps went back by %.3f s: the tracker restarts", (self._last_ns - stamp_ns) * 1e-9)
            self.tracker.reset()
            self._flow.start(None, None)
            self._margins, self._rejected, self._repeated, self._seen_ns = None, [], None, 0
            self._camera.reset()
        self._last_ns = stamp_ns
        roi = _validated_roi(roi)
        # A camera that repeats its picture shows nothing new: the bridge knows that by the same keypoints, bit for bit.
        rows = image[::_COMPARED_ROWS]
        if self._repeated is not None and roi is None and np.array_equal(rows, self._repeated[0]):
            return dataclasses.replace(self._repeated[1], stamp_ns=stamp_ns)
        observation, certain = self._observe(image, stamp_ns, roi, load_level)
        self._repeated = (rows.copy(), observation) if certain else None
        return observation

    def _observe(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None, load_level: int
    ) -> tuple[PoseObservation, bool]:
        """The subject in an image that differs from the last one, and whether it is certainly a person."""
        self._motion = motion = self._camera.update(image, [person.box for person in self.tracker.persons])
        if motion is not None:
            self.tracker.move_camera(motion)
            self._rejected = [(moved_box(motion, box), at_ns) for box, at_ns in self._rejected]
        self.keypoints = None
        observation = self._flow.propagate(image, stamp_ns) if roi is None and self._flow.steps < load_level else None
        if observation is not None:
            self._failures, self._seen_ns = 0, stamp_ns
            return observation, True
        predicted = self._estimate_predicted(image, stamp_ns, load_level) if roi is None else None
        self._seen_ns = stamp_ns if predicted and predicted[1] else self._seen_ns
        observation, certain = predicted or self._estimate_detected(image, stamp_ns, roi, load_level)
        # Doubtful persons are not propagated by optical flow; the detector runs again.
        self._flow.start(image if load_level and certain else None, observation)
        return observation, certain

    @property
    def propagated(self) -> bool:
        """Whether optical flow gave the last image's keypoints."""
        return self._flow.steps > 0

    def _estimate_detected(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None, load_level: int
    ) -> tuple[PoseObservation, bool]:
        """The subject by detection, and whether it is certainly a person."""
        size = (image.shape[1], image.shape[0])
        everything = self._detect(image, stamp_ns, load_level > 0)
        kept = without_parts(everything.boxes, everything.scores)
        found = Detections(everything.boxes[kept], everything.scores[kept])
        subject = self.tracker.update(image, stamp_ns, found.boxes, found.scores, roi)
        if subject is None:
            self._failures = 0
            self._judge_bystander(image, stamp_ns)
            subject = self.tracker.current(stamp_ns)
        self._detected_ns, self._score, self._confidence = stamp_ns, 0.0 if subject is None else subject.score, 0.0
        if subject is None:
            return PoseObservation(stamp_ns, 0, size), False
        if subject.hidden:
            return self._without_keypoints(stamp_ns, size, subject), False
        pause = load_level * min(2 ** (self._failures - 1), _LONGEST_PAUSE) if self._failures else 0
        if subject.score < _CLEAR_SCORE and self._paused < pause:
            self._paused += 1
            return self._without_keypoints(stamp_ns, size, subject), False
        self.keypoints = self.pose_model.estimate(image, subject.box)
        pose = self._calibrated(self.keypoints)
        self._confidence = pose.mean_confidence
        belief = _belief(pose, image, subject.box)
        if belief < _CLEAR_CONFIDENCE:
            subject, pose = self._compete(image, stamp_ns, subject, pose, belief, everything, load_level)
        self.tracker.judge(self._confidence, subject.box, stamp_ns)
        self._judge_bystander(image, stamp_ns, pose, load_level > 0)
        is_person = self._confidence >= CONFIRM_CONFIDENCE
        self._failures, self._paused = 0 if is_person else self._failures + 1, 0
        self._margins = None
        extent = pose.extent()
        if subject.score < self.config.detection_threshold:
            if extent is not None and is_person:
                margin = 0.06 * (extent[2:] - extent[:2]).max()
                self.tracker.confirm(extent + margin * np.array([-1, -1, 1, 1]), stamp_ns)
        elif extent is not None and subject.score >= _CLEAR_SCORE and self._confidence >= _CLEAR_CONFIDENCE:
            self._margins = (subject.box - extent) / (extent[2:] - extent[:2]).max()
        certain = is_person or subject.score >= self.config.detection_threshold
        blurred = sweeps(self._motion, subject.box)
        if is_person or (subject.score > 0 and (blurred or self._confidence >= EMPTY_CONFIDENCE)):
            self._seen_ns = stamp_ns
        elif stamp_ns - self._seen_ns > _UNSEEN_NS:
            return self._without_keypoints(stamp_ns, size, subject), False
        return self._observation(stamp_ns, size, subject, pose), certain

    def _compete(
        self,
        image: np.ndarray,
        stamp_ns: int,
        subject: Subject,
        pose: BodyPose,
        belief: float,
        found: Detections,
        load_level: int,
    ) -> tuple[Subject, BodyPose]:
        """Subject and pose, or those of a detection in whose pose the belief is clearly greater: it was a shadow."""
        boxes = found.boxes.astype(float)
        joints = pose.extent(CONFIRM_CONFIDENCE, 0.4) if subject.score > 0 else None
        if joints is not None:  # a box around person and shadow: its clear joints are the person's
            margin = 0.06 * (joints[2:] - joints[:2]).max()
            boxes = np.concatenate([boxes, [joints + margin * np.array([-1, -1, 1, 1])]])
        scores = np.append(found.scores, subject.score)[: len(boxes)]
        self._rejected = [(box, ns) for box, ns in self._rejected if stamp_ns - ns < _REJECTED_NS]
        known = np.array([box for box, _ in self._rejected]).reshape(-1, 4)
        rivals = self.tracker.rivals(image, stamp_ns, boxes, scores, belief)
        rivals = [j for j in rivals if not (iou(boxes[j][None], known) > _SAME_IOU).any()]
        for j in rivals[: _FEW_RIVALS if load_level else _RIVALS]:
            keypoints = self.pose_model.estimate(image, boxes[j])
            rival = self._calibrated(keypoints)
            rivals_belief = _belief(rival, image, boxes[j])
            if not wins(rivals_belief, belief):
                self._rejected.append((boxes[j], stamp_ns))
                continue
            subject = self.tracker.exchange(image, stamp_ns, boxes[j], float(scores[j]))
            self.keypoints, pose, belief = keypoints, rival, rivals_belief
            self._score, self._confidence = subject.score, pose.mean_confidence
        return subject, pose

    def _judge_bystander(
        self, image: np.ndarray, stamp_ns: int, subject: BodyPose | None = None, shedding: bool = False
    ) -> None:
        """Let the tracker know the pose of at most one other person: whether it is one, and not the subject again."""
        person = self.tracker.bystander_to_judge(stamp_ns, shedding)
        if person is not None:
            pose = self._calibrated(self.pose_model.estimate(image, person.box))
            same = subject is not None and pose.same_person(subject)
            blurred = sweeps(self._motion, person.box)
            self.tracker.judge_bystander(person, _belief(pose, image, person.box), stamp_ns, same, blurred)

    def _estimate_predicted(
        self, image: np.ndarray, stamp_ns: int, load_level: int
    ) -> tuple[PoseObservation, bool] | None:
        """The subject at its predicted box, without detection; None when a detection is due.

        An isolated subject with a clear pose updates the tracker.  Under load shedding any subject with a clear pose is
        estimated, without an update: in a crowd the joints may be another person's.
        """
        predicted = self.tracker.predict(stamp_ns)
        if predicted is None:
            return None
        size = (image.shape[1], image.shape[0])
        age_s, every_s = (stamp_ns - self._detected_ns) * 1e-9, self.config.detect_every_s
        shedding = load_level > 0 and self._confidence >= _CLEAR_CONFIDENCE
        shedding = shedding and not age_s > load_level * every_s - _SLACK_S
        margins = self._margins if shedding or not age_s > every_s - _SLACK_S else None
        if margins is not None and not self.tracker.isolated(predicted, size, stamp_ns):
            margins = None
        if margins is None and not shedding:
            return None
        keypoints = self.pose_model.estimate(image, predicted.box)
        pose = self._calibrated(keypoints)
        confidence = pose.mean_confidence
        extent = pose.extent()
        if margins is not None and extent is not None and confidence >= _CLEAR_CONFIDENCE:
            box = extent + margins * (extent[2:] - extent[:2]).max()
            box = np.clip(box, 0, np.array([*size, *size], float))
            self.tracker.propagate(box, stamp_ns)
            self.tracker.judge(confidence, box, stamp_ns)
            predicted = Subject(predicted.track_id, box, predicted.score, False)
        elif not shedding:
            return None
        self.keypoints, self._confidence = keypoints, confidence
        return self._observation(stamp_ns, size, predicted, pose), confidence >= CONFIRM_CONFIDENCE

    def _observation(self, stamp_ns: int, size: tuple[int, int], subject: Subject, pose: BodyPose) -> PoseObservation:
        xy, covariance, confidence = pose
        # Networks extrapolate beyond the image; nothing there was seen.
        outside = ~((xy >= 0) & (xy < np.array(size))).all(axis=1)
        confidence = np.where(outside, 0.0, confidence)
        unseen = outside | (confidence < self.config.keypoint_threshold)
        xy[unseen], covariance[unseen] = np.nan, np.nan
        return PoseObservation(
            stamp_ns, subject.track_id, size, self._joint_map.joints, subject.box.astype(np.float32), subject.score,
            xy.astype(np.float32), covariance.astype(np.float32), confidence.astype(np.float32),
        )  # fmt: skip

    def _detect(self, image: np.ndarray, stamp_ns: int, shedding: bool) -> Detections:
        """Detections of all windows together, parts of persons among them."""
        size = (image.shape[1], image.shape[0])
        found = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32))
        close = shedding and self._score >= _CLEAR_SCORE
        for window in self.tracker.windows(size, stamp_ns, single=shedding, close=close):
            found = _merged(found, self._detect_in(image, window, shedding))
        for further in () if shedding else (self.tracker.second_pass_window, self.tracker.sought_window):
            if (window := further(size, stamp_ns, found.boxes, found.scores)) is not None:
                found = _merged(found, self._detect_in(image, window))
        return found

    def _detect_in(self, image: np.ndarray, window: Window | None, shedding: bool = False) -> Detections:
        """Detections in a window, without those that its edge cuts."""
        reduced = None if not shedding else 1.0 if window is None else _REDUCED_INPUT
        found = self.detector.detect(image, window, self.config.low_threshold, reduced)
        kept = uncut(found.boxes, window, (image.shape[1], image.shape[0]))
        return Detections(found.boxes[kept], found.scores[kept])

    def _calibrated(self, keypoints: NetworkKeypoints) -> BodyPose:
        """The network's keypoints as joints of the body, with covariance and confidence."""
        spec = self.pose_model.spec
        covariance, confidence = calibrate(keypoints, spec.layout, spec.sigma_scale)
        return BodyPose(*self._joint_map.apply(keypoints.xy.astype(float), covariance, confidence, keypoints.box_size))

    def _without_keypoints(self, stamp_ns: int, size: tuple[int, int], subject: Subject) -> PoseObservation:
        """The subject at its predicted box, without keypoints."""
        joints = self._joint_map.joints
        points, spread = (np.full((len(joints), n), np.nan, np.float32) for n in (2, 3))
        return PoseObservation(
            stamp_ns, subject.track_id, size, joints, subject.box.astype(np.float32), 0.0,
            points, spread, np.zeros(len(joints), np.float32),
        )  # fmt: skip


def _merged(a: Detections, b: Detections) -> Detections:
    if not len(a) or not len(b):
        return b if len(b) else a
    boxes, scores = np.concatenate([a.boxes, b.boxes]), np.concatenate([a.scores, b.scores])
    kept = suppress(boxes, scores)
    return Detections(boxes[kept], scores[kept])


def _belief(pose: BodyPose, image: np.ndarray, box: np.ndarray) -> float:
    """Confidence in a person of a pose found in a box (4,) px."""
    confidence = pose.mean_confidence
    return confidence if confidence >= _CLEAR_CONFIDENCE else without_shadow(confidence, image, box)


def _check_image(image: np.ndarray) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or 0 in image.shape:
        raise InputError(f"image: expected (H, W, 3) uint8 BGR, got {image.dtype} {image.shape}; convert it")


def _validated_roi(roi: np.ndarray | None) -> np.ndarray | None:
    """The roi; None for an empty one, which in ROS means that there is none."""
    if roi is None:
        return None
    roi = np.asarray(roi, float)
    if roi.shape != (4,) or not np.isfinite(roi).all():
        raise InputError(f"roi: expected x_min y_min x_max y_max px, got {roi.tolist()}; correct its sender")
    return None if (roi[2:] <= roi[:2]).any() else roi
