"""Pose estimator: image -> the subject's keypoints, by detection, tracking, 2D pose and calibration."""

from __future__ import annotations

import dataclasses
import logging
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.load_models import limited_use, load_detector, load_feet_model, load_pose_model
from drocap_ros.perception.load_shedding import KeypointFlow
from drocap_ros.perception.pose.body_pose import CLEAR_CONFIDENCE, SEEN, BodyPose, BodyPoseModel
from drocap_ros.perception.pose.pose_model import NetworkKeypoints
from drocap_ros.perception.scene import JITTER_NS, Scene, SceneStep
from drocap_ros.perception.sources.base import Frame
from drocap_ros.perception.tracking.camera_motion import sweeps
from drocap_ros.perception.tracking.choice import CERTAIN_SCORE
from drocap_ros.perception.tracking.other_poses import OtherPoses
from drocap_ros.perception.tracking.person import CONFIRM_CONFIDENCE, Subject
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig
from drocap_ros.perception.tracking.search import SubjectSearch
from drocap_ros.perception.tracking.subject import SubjectTracker
from drocap_ros.skeleton import BODY_19

_UNSEEN_NS = 80_000_000  # without detection and believable pose until there are no keypoints: two images at 25 Hz
_LONGEST_PAUSE = 4  # of the pose network under load shedding, over that after a first failure: 0.4 s at 30 Hz

log = logging.getLogger(__name__)


class PoseEstimator:
    """Follows one person through the images of one camera; equal images give equal results.

    models_dir : folder with a person detector and a 2D pose model (``.onnx``)
    config : models, thresholds, choice of the subject
    """

    def __init__(self, models_dir: str | Path, config: PoseEstimatorConfig | None = None) -> None:
        self.config = config or PoseEstimatorConfig()
        self.pose_model = load_pose_model(models_dir, self.config)
        self.detector = load_detector(models_dir, self.config)
        #: The second network for feet; None without one.
        self.feet = load_feet_model(models_dir, self.config)
        #: Notice of a network that is not for images of real people; else empty.
        self.limited_use = limited_use(self.pose_model.model) or limited_use(self.detector.model)
        if self.limited_use:
            log.getChild("networks").warning("networks in use: %s", self.limited_use)
        self.tracker = SubjectTracker(self.config)
        self.search = SubjectSearch(self.detector, self.tracker, self.config)
        self.body = BodyPoseModel(self.pose_model)
        self.others = OtherPoses(self.tracker, self.body)
        self._flow = KeypointFlow()
        self._scene = Scene()
        self._beside = ThreadPoolExecutor(1, thread_name_prefix="scene")
        #: The next image and its scene's step, which another thread makes.
        self._ahead: tuple[Frame, Future[SceneStep]] | None = None
        #: Boxes of all persons after each of the last two images.
        self._boxes: deque[list[np.ndarray]] = deque([[], []], maxlen=2)
        #: (2, 3) of the image by the camera's since the last one; None where it is small or unknown.
        self.motion: np.ndarray | None = None
        self._last_ns: int | None = None
        #: The subject in the last image, if that certainly showed it.
        self._certain: PoseObservation | None = None
        #: Last run of the detector, and last image in which it, the pose or the optical flow showed the subject.
        self._detected_ns = self._seen_ns = 0
        #: Whether the detector ran in the last image: then it mostly runs in the next one, too.
        self._searching = False
        #: Score of the subject in the last detection, and mean confidence of its last keypoints; 0 = none.
        self._score = self._confidence = 0.0
        #: (4,) margins of the last box around the joints, over the joints' longer extent; None unless both were clear.
        self._margins: np.ndarray | None = None
        #: Consecutive runs of the pose network without a person, and images without a run since the last one.
        self._failures = self._paused = 0
        #: Keypoints of the pose network in the last image; None where it did not run.
        self.keypoints: NetworkKeypoints | None = None

    def process(
        self,
        image: np.ndarray,
        stamp_ns: int,
        roi: np.ndarray | None = None,
        load_level: int = 0,
        ahead: Frame | None = None,
        *,
        looks: bool = False,
    ) -> PoseObservation:
        """The subject in one image.

        image : (H, W, 3) uint8 BGR
        stamp_ns : exposure time; one earlier than the last image's resets the tracker, with a warning
        roi : (4,) x_min y_min x_max y_max px, box of the drone's own tracker, or a user's choice
        load_level : 0 = full work.  Above it: optical flow propagates the keypoints over up to ``load_level`` images
            after each run of the pose network; a detection has one window, no second pass, and after a clear pose
            an interval of ``load_level * detect_every_s``; after a run of the pose network without a person it pauses
            for ``load_level`` images, doubled at each further failure up to four times that, unless the detection is
            clear; from 2 on the scene's points are followed ten times a second
        ahead : the next image, whose scene another thread follows meanwhile; the results are the same without it
        looks : no keypoints by optical flow, whatever the level
        """
        roi = _validated_roi(roi)
        scene = self.begin(image, stamp_ns, ahead, seldom=load_level > 1)
        # A camera that repeats its picture shows nothing new: the bridge knows that by the same keypoints, bit for bit.
        if scene.again and self._certain is not None and roi is None:
            observation = dataclasses.replace(self._certain, stamp_ns=stamp_ns)
        else:
            if looks:
                self._flow.start(None, None)
            observation, certain = self._observe(image, stamp_ns, roi, load_level)
            self._certain = observation if certain else None
        self.end()
        return dataclasses.replace(observation, background=scene.points)

    def begin(self, image: np.ndarray, stamp_ns: int, ahead: Frame | None = None, *, seldom: bool = False) -> SceneStep:
        """The scene in an image, by which all persons move; the arguments are those of :meth:`process`."""
        _check_image(image)
        if self._last_ns is not None and stamp_ns < self._last_ns:
            log.warning("stamps went back by %.3f s: the tracker restarts", (self._last_ns - stamp_ns) * 1e-9)
            self.tracker.reset()
            self._flow.start(None, None)
            self._margins, self._certain, self._seen_ns = None, None, 0
        self._last_ns = stamp_ns
        scene = self._scene_of(image, stamp_ns, ahead, seldom=seldom)
        self.motion = scene.motion if self.tracker.persons else None
        if self.motion is not None:
            self.tracker.move_camera(self.motion)
        return scene

    def end(self) -> None:
        """Keep the places of all persons, which are no fixed points of the next image but one."""
        persons = (p for p in self.tracker.persons if not p.pose.value < CONFIRM_CONFIDENCE)
        self._boxes.append([person.box.copy() for person in persons])

    def _scene_of(self, image: np.ndarray, stamp_ns: int, ahead: Frame | None, *, seldom: bool) -> SceneStep:
        """The scene in this image; that in the next one is begun."""
        begun, self._ahead = self._ahead, None
        scene = None if begun is None else begun[1].result()
        if scene is None or begun is None or begun[0].image is not image:
            scene = self._scene.step(image, stamp_ns, self._boxes[0], seldom=seldom)
        if ahead is not None:
            step = self._beside.submit(self._scene.step, ahead.image, ahead.stamp_ns, self._boxes[1])
            self._ahead = ahead, step
        return scene

    def _observe(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None, load_level: int
    ) -> tuple[PoseObservation, bool]:
        """The subject in an image that differs from the last one, and whether it is certainly a person."""
        self.keypoints = predicted = None
        if roi is None:
            if self._flow.steps < load_level and (moved := self._flow.propagate(image, stamp_ns)) is not None:
                self._failures, self._seen_ns = 0, stamp_ns
                return moved, True
            predicted = self._estimate_predicted(image, stamp_ns, load_level)
        if predicted is not None:
            self._searching = False
            self._seen_ns = stamp_ns if predicted[1] else self._seen_ns
        observation, certain = predicted or self._estimate_detected(image, stamp_ns, roi, load_level)
        # Doubtful persons are not propagated by optical flow; the detector runs again.
        self._flow.start(image if load_level and certain else None, observation)
        return observation, certain

    def hand_over(self) -> KeypointFlow:
        """The optical flow from the last image on, of which this estimator then knows nothing."""
        flow, self._flow = self._flow, KeypointFlow()
        return flow

    @property
    def propagated(self) -> bool:
        """Whether optical flow gave the last image's keypoints."""
        return self._flow.steps > 0

    def _estimate_detected(
        self, image: np.ndarray, stamp_ns: int, roi: np.ndarray | None, load_level: int
    ) -> tuple[PoseObservation, bool]:
        """The subject by detection, and whether it is certainly a person."""
        shedding = load_level > 0
        found = self.search.detect(image, stamp_ns, shedding, close=shedding and self._score >= CERTAIN_SCORE)

        def look() -> None:
            self.others.judge(image, stamp_ns, None, self.motion, shedding)

        subject = self.tracker.update(image, stamp_ns, found.boxes, found.scores, roi, look)
        if self._ahead is not None and self._searching and not shedding:
            self.search.begin(self._ahead[0].image, self._ahead[0].stamp_ns, self._beside)
        self._searching = True
        if subject is None:
            self._failures = 0
        self._detected_ns, self._score, self._confidence = stamp_ns, 0.0 if subject is None else subject.score, 0.0
        if subject is None:
            return PoseObservation(stamp_ns, 0, _size(image)), False
        if subject.hidden or self._pauses(subject, load_level):
            return self.observation(image, stamp_ns, subject), False
        return self._estimate_pose(image, stamp_ns, subject, shedding)

    def _pauses(self, subject: Subject, load_level: int) -> bool:
        """Whether the pose network rests under load shedding, after runs without a person and a clear detection."""
        pause = load_level * min(2 ** (self._failures - 1), _LONGEST_PAUSE) if self._failures else 0
        if subject.score >= CERTAIN_SCORE or self._paused >= pause:
            return False
        self._paused += 1
        return True

    def _estimate_pose(
        self, image: np.ndarray, stamp_ns: int, subject: Subject, shedding: bool
    ) -> tuple[PoseObservation, bool]:
        """The pose of the detected or predicted subject."""
        pose = self.body.estimate(image, subject.box)
        subject, pose = self.others.best(image, stamp_ns, subject, pose, shedding)
        self.keypoints, self._score, self._confidence = pose.network, subject.score, pose.mean_confidence
        if (around := pose.box()) is not None and self.tracker.is_others(around, stamp_ns):
            self._failures, self._margins = 0, None
            return self.observation(image, stamp_ns, subject), False
        self.tracker.judge(self._confidence, subject.box, stamp_ns, pose.limbs())
        self.others.judge(image, stamp_ns, pose, self.motion, shedding)
        is_person = self._confidence >= CONFIRM_CONFIDENCE
        self._failures, self._paused = 0 if is_person else self._failures + 1, 0
        detected = subject.score >= self.config.detection_threshold
        if is_person and not detected and (box := pose.box()) is not None:
            self.tracker.confirm(box, stamp_ns)
        self._margins = self._clear_margins(subject, pose) if detected else None
        if is_person or self._is_in_view(subject):
            self._seen_ns = stamp_ns
        elif stamp_ns - self._seen_ns > _UNSEEN_NS:
            return self.observation(image, stamp_ns, subject), False
        return self.observation(image, stamp_ns, subject, pose), is_person or detected

    def _is_in_view(self, subject: Subject) -> bool:
        """Whether a detected subject's last pose, doubtful as it is, may be a person's."""
        return subject.score > 0 and (self._confidence >= SEEN or sweeps(self.motion, subject.box))

    def _clear_margins(self, subject: Subject, pose: BodyPose) -> np.ndarray | None:
        """(4,) margins of the box around the joints, over their longer extent; None unless both are clear."""
        if subject.score < CERTAIN_SCORE or self._confidence < CLEAR_CONFIDENCE or (extent := pose.extent()) is None:
            return None
        margins: np.ndarray = (subject.box - extent) / (extent[2:] - extent[:2]).max()
        return margins

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
        age_s, every_s = (stamp_ns - self._detected_ns) * 1e-9, self.config.detect_every_s
        shedding = self._confidence >= CLEAR_CONFIDENCE and age_s <= load_level * every_s - 1e-9 * JITTER_NS
        recent = shedding or age_s <= every_s - 1e-9 * JITTER_NS
        alone = recent and self._margins is not None and self.search.isolated(predicted.box, _size(image), stamp_ns)
        if not (alone or shedding):
            return None
        pose = self.body.estimate(image, predicted.box)
        subject = self._moved(predicted, pose, _size(image), stamp_ns) if alone else None
        if subject is None and not shedding:
            return None
        self.keypoints, self._confidence = pose.network, pose.mean_confidence
        return self.observation(image, stamp_ns, subject or predicted, pose), self._confidence >= CONFIRM_CONFIDENCE

    def _moved(self, subject: Subject, pose: BodyPose, size: tuple[int, int], stamp_ns: int) -> Subject | None:
        """The subject at the box around a clear pose's joints, in the tracker too; None where it is not clear."""
        confidence, extent = pose.mean_confidence, pose.extent()
        if extent is None or confidence < CLEAR_CONFIDENCE or self._margins is None:
            return None
        box = extent + self._margins * (extent[2:] - extent[:2]).max()
        box = np.clip(box, 0, np.tile(np.array(size, float), 2))
        self.tracker.propagate(box, stamp_ns)
        self.tracker.judge(confidence, box, stamp_ns, pose.limbs())
        return Subject(subject.track_id, box, subject.score, False)

    def observation(
        self, image: np.ndarray, stamp_ns: int, subject: Subject, pose: BodyPose | None = None
    ) -> PoseObservation:
        """The subject in the image; without a pose, its predicted box without keypoints."""
        joints, size = BODY_19 if self.feet else self.body.joint_map.joints, _size(image)
        if pose is not None and self.feet is not None:
            pose = self.feet.add(image, subject.box, pose)
        if pose is None:
            confidence: np.ndarray = np.zeros(len(joints))
            xy, covariance = (np.full((len(joints), n), np.nan) for n in (2, 3))
        else:
            xy, covariance = pose.xy, pose.covariance
            # Networks extrapolate beyond the image; nothing there was seen.
            outside = ~((xy >= 0) & (xy < np.array(size))).all(axis=1)
            confidence = np.where(outside, 0.0, pose.confidence)
            unseen = outside | (confidence < self.config.keypoint_threshold) | (confidence == 0)
            xy[unseen], covariance[unseen] = np.nan, np.nan
        score = 0.0 if pose is None else subject.score
        box, xy, covariance, confidence = (a.astype(np.float32) for a in (subject.box, xy, covariance, confidence))
        space = None if pose is None or pose.space is None else pose.space.astype(np.float32)
        return PoseObservation(
            stamp_ns, subject.track_id, size, joints, box, score, xy, covariance, confidence, space=space
        )


def _size(image: np.ndarray) -> tuple[int, int]:
    return image.shape[1], image.shape[0]


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
