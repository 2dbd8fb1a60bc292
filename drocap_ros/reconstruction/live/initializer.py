"""The live initializer: one image's keypoints in, a pose out; causal, bounded memory."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from statistics import median
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import LIMBS_PER_STATURE, bone_lengths, limb_lengths
from drocap_ros.keypoints import Keypoints2D, PoseObservation
from drocap_ros.leg_sides import with_own_legs
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.common.windows import even_slots
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.lifted.network import LifterInput
from drocap_ros.reconstruction.live.frame_buffer import StreamEvent, StreamOrder
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, check_uncertainty
from drocap_ros.skeleton import BODY_17

#: Images between two estimates of the proportions, a second of the lifter's rate; the first one comes after half of it.
_ESTIMATE_EVERY = 24
#: Estimates kept, of which the median counts: of most of a minute.
_ESTIMATES = 40

#: Images over which the size in the image is the median.
SIZE_IMAGES = 30

#: Most images of the past at any frame rate.
MAX_IMAGES = 400


class LiftedImage(NamedTuple):
    """joints (17, 3) px in camera axes, x and y in the image; std (17, 2) px across and along the ray; m per px."""

    joints: np.ndarray
    std: np.ndarray
    metres: float


class StreamLifter:
    """Keeps the last ``past_s`` of keypoints and the person's proportions."""

    def __init__(self, lifter: Lifter, past_s: float, height_m: float) -> None:
        self._lifter = lifter
        self._past_ns = round(past_s * 1e9)
        self._limbs_m = height_m * LIMBS_PER_STATURE
        self._past: deque[tuple[int, np.ndarray, np.ndarray]] = deque(maxlen=MAX_IMAGES)
        self._proportions: deque[np.ndarray] = deque(maxlen=_ESTIMATES)
        self._since_estimate = 0
        self._limbs_px: deque[float] = deque(maxlen=SIZE_IMAGES)

    def forget_motion(self) -> None:
        """After a gap: the same person, elsewhere in the image."""
        self._past.clear()
        self._limbs_px.clear()
        self._since_estimate = 0

    def forget_person(self) -> None:
        """Another person, other pixels, or another pass of time."""
        self.forget_motion()
        self._proportions.clear()

    def push(self, stamp_ns: int, keypoints: np.ndarray, confidence: np.ndarray) -> LiftedImage:
        """Lift the next image: keypoints (17, 2) px, NaN where not seen; confidence (17,)."""
        self._past.append((stamp_ns, keypoints, confidence))
        while self._past[0][0] < stamp_ns - self._past_ns:
            self._past.popleft()
        stamps = np.array([stamp for stamp, _, _ in self._past], np.int64)
        slot, fps = even_slots(stamps)
        points = np.full((slot[-1] + 1, *keypoints.shape), np.nan)
        weight = np.zeros(points.shape[:2])
        points[slot], weight[slot] = self._with_own_legs(stamps)
        self._since_estimate += 1
        if self._since_estimate >= _ESTIMATE_EVERY // (1 if self._proportions else 2):
            self._since_estimate = 0
            self._estimate_proportions(points, weight, fps)
        lifted = self._lifter.lift_last(LifterInput(points, weight, self._lengths_px()), fps)
        joints = lifted.joints[0]
        self._limbs_px.append(max(float(limb_lengths(joints).sum()), 1e-9))
        metres = self._limbs_m / median(self._limbs_px)
        return LiftedImage(joints, lifted.sigma[0] * np.array(self._lifter.errors.newest), metres)

    def _with_own_legs(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and confidences of the past; legs that the network exchanged are exchanged back."""
        points = np.array([k for _, k, _ in self._past])
        weight = np.array([c for _, _, c in self._past])
        past = with_own_legs(Keypoints2D(points, weight), stamps, person_size(points))
        return past.xy, past.weights

    def _estimate_proportions(self, points: np.ndarray, weight: np.ndarray, fps: float) -> None:
        # The lifter gets no lengths here: fed with its own estimates, it drifts within a second.
        joints = self._lifter.lift(LifterInput(points, weight), fps).joints
        lengths = bone_lengths(joints)
        self._proportions.append(np.median(lengths / limb_lengths(joints).sum(axis=-1, keepdims=True), axis=0))

    def _lengths_px(self) -> np.ndarray | None:
        if not self._proportions or not self._limbs_px:
            return None
        lengths: np.ndarray = np.median(np.array(self._proportions), axis=0) * median(self._limbs_px)
        return lengths


def person_size(keypoints: np.ndarray) -> np.ndarray:
    """(F,) px, the median over the images of the person's longer side, for keypoints (F, P, 2)."""
    low = np.fmin.reduce(keypoints, axis=1)
    high = np.fmax.reduce(keypoints, axis=1)
    size = (high - low).max(axis=-1)
    known = size[np.isfinite(size)]
    return np.full(len(keypoints), np.median(known) if len(known) else 1.0)


@dataclass(frozen=True)
class LivePose:
    """Pose of one image as published.

    joints3d : (P, 3) m, camera axes with the pelvis at the origin, or in ``map`` where ``rotation`` is known; NaN when
        the image shows too little
    covariance : (P, 6) m^2, xx xy xz yy yz zz
    confidence : (P,) in [0, 1], 0 where the joint was not seen and the model filled it in
    refined : whether the bones have the lengths of an adjusted window
    rotation : (3, 3) ``map`` -> camera, corrected
    """

    stamp_ns: int
    track_id: int
    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: float
    refined: bool = False
    rotation: np.ndarray | None = None


class LiveInitializer:
    """Lifts each image of a stream with the last ``past_s`` of keypoints (:mod:`stream_lifter`).

    ``event`` is the last image's (:mod:`stream_order`): duplicates, late images and stray stamps are dropped; another
    subject, another image size or a jump of time restarts; a gap keeps only the person's proportions.
    """

    def __init__(self, config: InitializerConfig | None = None) -> None:
        self.config = config or InitializerConfig()
        lifter = Lifter.load(self.config.lifter or None, quick=True)
        self._lifter = StreamLifter(lifter, self.config.past_s, self.config.assumed_height_m)
        self._order = StreamOrder(self.config.late_s, self.config.gap_s)
        self.event = StreamEvent.FIRST

    def push(self, observation: PoseObservation) -> LivePose | None:
        """Pose of the next image, or None when ``event`` drops it."""
        keypoints = _keypoints(observation)
        self.event = self._order.classify(observation.stamp_ns, observation.track_id, observation.image_size)
        if self.event.dropped:
            return None
        if self.event.restarted:
            self._lifter.forget_person()
        elif self.event is StreamEvent.GAP:
            self._lifter.forget_motion()
        confidence = keypoints.weights
        seen = confidence > 0.0
        extent = np.ptp(keypoints.xy[seen], axis=0).max() if seen.any() else 0.0
        if seen.sum() < MIN_JOINTS or not extent > 1e-3:
            nothing = np.full((len(BODY_17), 3), np.nan), np.full((len(BODY_17), 6), np.nan), np.zeros(len(BODY_17))
            return LivePose(observation.stamp_ns, observation.track_id, *nothing, float("nan"))
        check_uncertainty(keypoints[None], seen[None])
        points = np.where(seen[:, None], keypoints.xy, np.nan)
        joints, std, metres = self._lifter.push(observation.stamp_ns, points, confidence)
        gap = joints[seen, :2] - keypoints.xy[seen]
        covariance = np.zeros((len(BODY_17), 6))
        covariance[:, [0, 3, 5]] = std[:, [0, 0, 1]] ** 2
        return LivePose(
            observation.stamp_ns,
            observation.track_id,
            joints3d=(joints - joints[BODY_17.index("pelvis")]) * metres,
            covariance=covariance * metres**2,
            confidence=confidence,
            reprojection_rms_px=float(np.sqrt(np.mean(np.sum(gap**2, axis=-1)))),
        )


def _keypoints(observation: PoseObservation) -> Keypoints2D:
    """The image's keypoints of ``BODY_17``; a covariance of NaN alone is left out."""
    keypoints = observation.body_keypoints()
    if np.isinf(observation.keypoints).any():
        raise InputError("keypoints: expected finite px or NaN, got infinity; check the 2D joints")
    assert keypoints.covariance is not None
    return replace(keypoints, covariance=None) if np.isnan(keypoints.covariance).all() else keypoints
