"""Pose estimation over a whole recording, and the tracks of its subjects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from drocap_ros.background import MOST_ROWS, of_images
from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import assumed_camera, towards
from drocap_ros.keypoints import Keypoints2D, PoseObservation
from drocap_ros.leg_sides import with_own_legs
from drocap_ros.perception.estimator import PoseEstimator
from drocap_ros.perception.sources.base import Frame, prefetch, with_next
from drocap_ros.tracks import Tracks


def observe(
    frames: Iterable[Frame],
    estimator: PoseEstimator,
    on_frame: Callable[[Frame, PoseObservation], None] | None = None,
    begin_ns: int | None = None,
    threads: int = 2,
) -> list[PoseObservation]:
    """Observations of all frames: the same, bit for bit, with any number of threads.

    With two or more, one decodes ahead and one follows the scene of the next image, and runs the detector in it where
    this image needed it, while this one estimates the pose: each of them needs its own result of the last image.

    frames : a source, or frames in the order of time
    estimator : a fresh one; it keeps its subject between calls
    on_frame : called with each frame and its observation, for progress and overlays
    begin_ns : frames before it are observations without a subject
    threads : 1 = this one does everything

    Of a recording with more than ``MOST_ROWS`` of them, the fixed points of every second, fourth ... image are kept.
    """
    observations: list[PoseObservation] = []
    thin = _ThinPoints()
    for frame, ahead in with_next(prefetch(frames) if threads > 1 else frames):
        if begin_ns is not None and frame.stamp_ns < begin_ns:
            observation = PoseObservation(frame.stamp_ns, 0, (frame.image.shape[1], frame.image.shape[0]))
        else:
            observation = estimator.process(frame.image, frame.stamp_ns, ahead=ahead if threads > 1 else None)
        if on_frame is not None:
            on_frame(frame, observation)
        observations.append(observation)
        thin(observations)
    return observations


class _ThinPoints:
    """Keeps the fixed points of every second, fourth ... image where there are more than ``MOST_ROWS`` of them."""

    def __init__(self) -> None:
        self._rows, self._every = 0, 1

    def __call__(self, observations: list[PoseObservation]) -> None:
        """After each new observation."""
        self._drop(observations, len(observations) - 1)
        self._rows += _rows(observations[-1])
        if self._rows > MOST_ROWS:
            self._every *= 2
            self._drop(observations, 0)
            self._rows = sum(map(_rows, observations))

    def _drop(self, observations: list[PoseObservation], begin: int) -> None:
        for i in range(begin, len(observations)):
            if i % self._every:
                observations[i] = replace(observations[i], background=None)


def _rows(observation: PoseObservation) -> int:
    return 0 if observation.background is None else len(observation.background)


def subjects(observations: Sequence[PoseObservation]) -> list[tuple[int, int]]:
    """(track_id, number of images with keypoints) of each subject, by falling number."""
    count = Counter(o.track_id for o in observations if o.track_id and np.isfinite(o.keypoints).any())
    return sorted(count.items(), key=lambda item: (-item[1], item[0]))


def tracks_from_observations(observations: Sequence[PoseObservation], track_id: int | None = None) -> Tracks:
    """Tracks of one subject, of None the one with keypoints in most images, over all images; NaN in those without it.

    Legs that the network exchanged for some images are put right (:mod:`drocap_ros.leg_sides`).  An InputError says
    that there are no images, or that none shows the subject.
    """
    if not observations:
        raise InputError("images: expected at least one, got none")
    if track_id is None:
        found = subjects(observations)
        track_id = found[0][0] if found else 0
    mine = np.array([o.track_id == track_id and track_id > 0 for o in observations])
    if not mine.any():
        raise InputError(
            f"expected a person in view, found none in {len(observations)} images; try another video or model"
        )
    joints = observations[int(np.argmax(mine))].joints
    shape = (len(observations), len(joints))
    keypoints = np.full((*shape, 2), np.nan)
    covariance = np.full((*shape, 3), np.nan)
    confidence = np.zeros(shape)
    for i in np.nonzero(mine)[0]:
        keypoints[i], covariance[i] = observations[i].keypoints, observations[i].covariance
        confidence[i] = observations[i].confidence
    stamp_ns = np.array([o.stamp_ns for o in observations], np.int64)
    rois = np.array([o.roi for o in observations], float)
    box_size = np.nan_to_num((rois[:, 2:] - rois[:, :2]).max(axis=1))
    corrected = with_own_legs(Keypoints2D(keypoints, confidence, covariance), stamp_ns, box_size)
    return Tracks(
        keypoints=corrected.xy,
        joints=joints.joints,
        stamp_ns=stamp_ns,
        image_size=observations[0].image_size,
        confidence=corrected.confidence,
        covariance=corrected.covariance,
        real_lens=True,
        background=of_images(o.background for o in observations),
        evidence=_evidence(observations, mine, len(joints), rois),
    )


def _evidence(
    observations: Sequence[PoseObservation], mine: np.ndarray, joints: int, rois: np.ndarray
) -> np.ndarray | None:
    """(F, joints, 3) m, joints in space in the cameras' axes, of a lens as it is assumed; None = there are none.

    Their errors are left out: the adjustment measures them across the image, in each recording.

    mine : (F,) bool, the images of the subject; rois : (F, 4) px, its boxes
    """
    if not any(observations[i].space is not None for i in np.nonzero(mine)[0]):
        return None
    space = np.full((len(observations), joints, 3), np.nan)
    for i in np.nonzero(mine)[0]:
        if (seen := observations[i].space) is not None:
            space[i] = seen
    camera = assumed_camera(observations[0].image_size)
    ray = (0.5 * (rois[:, :2] + rois[:, 2:]) - camera[:2, 2]) / np.diagonal(camera)[:2]
    return np.asarray(space @ towards(np.nan_to_num(ray)))
