"""Less work per image while images queue: keypoints by optical flow instead of a network.

Pyramidal Lucas-Kanade (Bouguet 2001) around each joint, forward and backward (forward-backward error, Kalal et al.
2010).  At 30 Hz, joints whose backward flow returns to within 0.2 % of the box are as accurate as the network's
repeatability: median 0.3 to 0.6 % of the box, 1 to 2 % at the 90th percentile.
"""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from drocap_ros.keypoints import PoseObservation
from drocap_ros.perception.models.network_input import shrink
from drocap_ros.perception.sources.base import Frame

_SIDE_PX = 192  # longer side of the box in the flow's image; smaller boxes are not enlarged
_MARGIN = 0.25  # around the box, share of its longer side
_WINDOW_PX = 15  # of the flow around each joint
_LEVELS = 2  # of the flow's pyramid: steps up to 7 * 2^2 = 28 px
_SIGMA = 0.005  # standard deviation that each step adds, share of the box's longer side; measured as above
_MAX_ERROR = 2 * _SIGMA  # largest forward-backward error of a joint, which adds to it, same unit
_MIN_VALID = 0.5  # least share of valid joints; below it the scene changed or the image is blurred
_FEW_VALID = 0.25  # where the networks do not look at the image in any case: 2 instead of 8 % have no keypoints,
_MANY_STEPS_SIGMA = 2 * _SIGMA  # and after four to seven steps joints err by 1.5 % in the median and 18 % at the 95th
_LONGEST_S = 0.1  # between the two images: three of 30 Hz
_MOST_IMAGES = 24  # that pass while the networks look at one: 0.8 s of 30 Hz
_ALONE_NS = 800_000_000  # since the image that they looked at last: a network that hangs shows no subject


class KeypointFlow:
    """Propagates keypoints from image to image.

    Attributes
    ----------
    least, sigma : least share of valid joints, and standard deviation that a step adds, share of the box's longer side
    steps : number of propagations since the network's last keypoints
    """

    def __init__(self) -> None:
        self.least, self.sigma = _MIN_VALID, _SIGMA
        self.steps = 0
        #: Grey region around the subject in the last image, and the keypoints in that.
        self._reference: tuple[np.ndarray, PoseObservation] | None = None

    def start(self, image: np.ndarray | None, observation: PoseObservation | None) -> None:
        """Set the reference: an image (H, W, 3) uint8 BGR and the network's keypoints in it; None = no reference."""
        self.steps = 0
        self._keep(image, observation)

    def _keep(self, image: np.ndarray | None, observation: PoseObservation | None) -> None:
        """Reference for the next image; None without keypoints or with a box too small for the flow's window."""
        self._reference = None
        if image is None or observation is None or not np.isfinite(observation.keypoints).any():
            return
        region, length = _around(observation)
        if observation.has_subject and (region[2:] - region[:2]).min() > 2 * _WINDOW_PX:
            self._reference = _view(image, region, length), observation

    def propagate(self, image: np.ndarray, stamp_ns: int) -> PoseObservation | None:
        """The same subject in the next image; None without a reference or with too few valid joints.

        Invalid joints are NaN, and the box moves with the others.  Covariances grow by the flow's error; scores and
        confidences stay.
        """
        size = (image.shape[1], image.shape[0])
        if self._reference is None or size != self._reference[1].image_size:
            return None
        last, before = self._reference
        if not 0 < (stamp_ns - before.stamp_ns) * 1e-9 <= _LONGEST_S:
            return None
        known = np.isfinite(before.keypoints).all(axis=1)
        region, length = _around(before)
        view = _view(image, region, length)
        if np.array_equal(view, last):  # keypoints of a picture that stands still repeat bit for bit
            return self._step(image, dataclasses.replace(before, stamp_ns=stamp_ns))
        scale = np.array([view.shape[1], view.shape[0]]) / (region[2:] - region[:2])
        start = ((before.keypoints[known] - region[:2]) * scale).astype(np.float32)
        forward, found = _flow(last, view, start)
        backward, found_backward = _flow(view, last, forward)
        error = np.linalg.norm((backward - start) / scale, axis=1) / length
        moved = forward / scale + region[:2]
        valid = found & found_backward & (error <= _MAX_ERROR) & ((moved >= 0) & (moved < size)).all(axis=1)
        if valid.sum() < self.least * known.sum():
            return None
        joints = np.nonzero(known)[0][valid]
        keypoints = np.full_like(before.keypoints, np.nan)
        covariance = np.full_like(before.covariance, np.nan)
        confidence = np.zeros_like(before.confidence)
        keypoints[joints] = moved[valid]
        variance = ((self.sigma**2 + error[valid] ** 2) * length**2)[:, None]
        covariance[joints] = before.covariance[joints] + variance * np.array([1.0, 0.0, 1.0])
        confidence[joints] = before.confidence[joints]
        shift = np.median(keypoints[joints] - before.keypoints[joints], axis=0)
        roi = np.clip(before.roi + np.tile(shift, 2), 0, np.tile(size, 2)).astype(np.float32)
        observation = dataclasses.replace(
            before,
            stamp_ns=stamp_ns,
            roi=roi,
            keypoints=keypoints,
            covariance=covariance,
            confidence=confidence,
            space=None,
        )
        return self._step(image, observation)

    def _step(self, image: np.ndarray, observation: PoseObservation) -> PoseObservation:
        self.steps += 1
        self._keep(image, observation)
        return observation


class Follower:
    """Keypoints of every image while the networks look at one of those before.

    flow : with the keypoints of the last image, if they are known
    """

    def __init__(self, flow: KeypointFlow) -> None:
        self._flow = flow
        flow.least, flow.sigma = _FEW_VALID, _MANY_STEPS_SIGMA
        #: From the one on that the networks look at; so many may pass meanwhile.
        self._images: deque[Frame] = deque(maxlen=_MOST_IMAGES)
        #: The networks' last word where that had no keypoints: it holds until the next one.
        self._nothing: PoseObservation | None = None
        self._looked_ns: int | None = None

    def follow(self, frame: Frame) -> PoseObservation | None:
        """The subject in the next image; None where too little of it is found, or no network looks any more."""
        self._images.append(frame)
        if self._nothing is not None:
            return dataclasses.replace(self._nothing, stamp_ns=frame.stamp_ns, background=None)
        self._looked_ns = frame.stamp_ns if self._looked_ns is None else self._looked_ns
        if frame.stamp_ns - self._looked_ns > _ALONE_NS:
            return None
        return self._flow.propagate(frame.image, frame.stamp_ns)

    def correct(self, seen: PoseObservation) -> None:
        """Begin anew from the networks' keypoints, doubtful ones too, in an image that was followed."""
        while self._images and self._images[0].stamp_ns < seen.stamp_ns:
            self._images.popleft()
        if not self._images or self._images[0].stamp_ns != seen.stamp_ns:
            return
        self._looked_ns = seen.stamp_ns
        self._nothing = None if np.isfinite(seen.keypoints).any() else seen
        first, *later = self._images
        self._flow.start(first.image, seen)
        for frame in later:
            self._flow.propagate(frame.image, frame.stamp_ns)


def _around(observation: PoseObservation) -> tuple[np.ndarray, float]:
    """(4,) px of the region around the subject, whole numbers, and the longer side of its box."""
    box = observation.roi.astype(float)
    length = float((box[2:] - box[:2]).max())
    low = np.clip(np.floor(box[:2] - _MARGIN * length), 0, None)
    high = np.minimum(np.ceil(box[2:] + _MARGIN * length), observation.image_size)
    return np.concatenate([low, high]), length


def _flow(view: np.ndarray, later: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2) float32 px in the later view, and whether they were found (N,)."""
    import cv2

    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        view, later, points, points.copy(), winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=_LEVELS
    )
    return np.asarray(moved), np.asarray(found)[:, 0] == 1


def _view(image: np.ndarray, region: np.ndarray, length: float) -> np.ndarray:
    """The region in grey, scaled so that the person is at most ``_SIDE_PX`` long."""
    import cv2

    x0, y0, x1, y1 = region.astype(int)
    grey = cv2.cvtColor(image[y0:y1, x0:x1], cv2.COLOR_BGR2GRAY)
    scale = min(1.0, _SIDE_PX / length)
    return shrink(grey, (max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))))
