"""The live initializer: one image's keypoints in, a pose out; causal, bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.lifted.lifter import Lifter
from drocap_ros.reconstruction.live.stream_lifter import StreamLifter
from drocap_ros.reconstruction.live.stream_order import StreamEvent, StreamOrder
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, check_uncertainty
from drocap_ros.skeleton import BODY_17


@dataclass(frozen=True)
class InitialPose:
    """Pose of one image.

    joints3d : (17, 3) m, camera axes, pelvis at the origin; NaN when the image shows too little
    covariance : (17, 6) m^2, xx xy xz yy yz zz
    confidence : (17,) in [0, 1], 0 where the joint was not seen and the model filled it in
    """

    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: float


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

    def push(self, observation: PoseObservation) -> InitialPose | None:
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
            return _unknown()
        check_uncertainty(keypoints[None], seen[None])
        points = np.where(seen[:, None], keypoints.xy, np.nan)
        joints, std, metres = self._lifter.push(observation.stamp_ns, points, confidence)
        gap = joints[seen, :2] - keypoints.xy[seen]
        covariance = np.zeros((len(BODY_17), 6))
        covariance[:, [0, 3, 5]] = std[:, [0, 0, 1]] ** 2
        return InitialPose(
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


def _unknown() -> InitialPose:
    p = len(BODY_17)
    return InitialPose(np.full((p, 3), np.nan), np.full((p, 6), np.nan), np.zeros(p), float("nan"))
