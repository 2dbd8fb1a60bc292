"""Calibrated keypoints of one body in one image, and the network that gives them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.joint_maps import joint_map
from drocap_ros.perception.pose import NetworkKeypoints, PoseModel
from drocap_ros.perception.pose.uncertainty import calibrate
from drocap_ros.perception.tracking.shadow import without_shadow
from drocap_ros.skeleton import BODY_15

#: Mean confidence of a clear pose.
CLEAR_CONFIDENCE = 0.8
#: Least confidence of a joint that counts.
_SEEN = 0.3
#: Median distance of the joints of two poses below which they are one person's, share of the body's longer extent.
_SAME = 0.05
#: Margin of a person's box around the joints, share of their longer extent.
_MARGIN = 0.06
_OUTWARD = np.array([-1, -1, 1, 1])


class BodyPose(NamedTuple):
    """Joints that the network gives, ``BODY_15`` first: (P, 2) px, (P, 3) px^2, (P,); and its own keypoints."""

    xy: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    network: NetworkKeypoints

    @property
    def mean_confidence(self) -> float:
        """Over ``BODY_15``: the thresholds hold for networks with and without feet."""
        return float(self.confidence[: len(BODY_15)].mean())

    def extent(self, least: float = _SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the joints; None when fewer than a share of ``BODY_15`` are seen with the least confidence."""
        seen = self.confidence[: len(BODY_15)] >= least
        if seen.sum() < share * len(seen):
            return None
        xy = self.xy[: len(BODY_15)][seen]
        return np.concatenate([xy.min(axis=0), xy.max(axis=0)])

    def box(self, least: float = _SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the person with these joints; None as for :meth:`extent`."""
        joints = self.extent(least, share)
        return None if joints is None else joints + _MARGIN * (joints[2:] - joints[:2]).max() * _OUTWARD

    def belief(self, image: np.ndarray, box: np.ndarray) -> float:
        """Confidence that the box (4,) px of this pose shows a person; shadow in the box reduces it."""
        confidence = self.mean_confidence
        return confidence if confidence >= CLEAR_CONFIDENCE else without_shadow(confidence, image, box)

    def same_person(self, other: BodyPose) -> bool:
        """Whether two boxes of one image gave the joints of one person."""
        seen = np.minimum(self.confidence, other.confidence)[: len(BODY_15)] >= _SEEN
        if seen.sum() < 0.5 * len(seen):
            return False
        xy = other.xy[: len(BODY_15)][seen]
        apart = np.linalg.norm(self.xy[: len(BODY_15)][seen] - xy, axis=1)
        return bool(np.median(apart) < _SAME * np.ptp(xy, axis=0).max())


class BodyPoseModel:
    """A pose network, its keypoints mapped to joints of the body and calibrated."""

    def __init__(self, model: PoseModel) -> None:
        self._model = model
        self.joint_map = joint_map(model.joints.name)

    def estimate(self, image: np.ndarray, box: np.ndarray) -> BodyPose:
        """Pose of the person in a box (4,) px of an image (H, W, 3) uint8 BGR."""
        keypoints, spec = self._model.estimate(image, box), self._model.spec
        covariance, confidence = calibrate(keypoints, spec.layout, spec.sigma_scale)
        joints = self.joint_map.apply(keypoints.xy.astype(float), covariance, confidence, keypoints.box_size)
        return BodyPose(*joints, keypoints)
