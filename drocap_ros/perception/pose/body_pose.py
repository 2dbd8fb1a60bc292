"""Calibrated keypoints of one body in one image, the network that gives them, and the shadow that they may lie on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.perception.pose.pose_model import NetworkKeypoints, PoseModel
from drocap_ros.perception.pose.uncertainty import calibrate
from drocap_ros.skeleton import BODY_15, joint_map

CLEAR_CONFIDENCE = 0.8  # mean confidence of a clear pose; persons in bad light or from steeply above have 0.5 to 0.9
_SEEN = 0.3  # least confidence of a joint that counts: boxes without a person have a mean below 0.33
_SAME = 0.05  # median distance of one person's joints in two boxes, share of the body's longer extent
_MARGIN = 0.06  # of a person's box around the joints, share of their longer extent: head and feet
_PATCH_PX = 32  # side of the patch in which a shadow is sought
_AROUND = 0.3  # margin around the box that shows the ground, share of its sides
#: Brightness of a shadow over that of the ground, sRGB: sun and sky over sky alone; black clothes are darker.
_SHADOW = (0.3, 0.85)
_TINT = 0.14  # largest difference between the channels' ratios in a shadow; skylight makes it bluer
_DIFFERENT = 0.15  # least difference from the ground of what stands or lies on it, share of the brightness
_LEAST_DIFFERENT = 0.08  # least share of the box that differs from the ground
_PENALTY = 0.3  # what a box full of shadow takes from the confidence of its pose, from half a box on


class BodyPose(NamedTuple):
    """Joints that the network gives, ``BODY_15`` first: (P, 2) px, (P, 3) px^2, (P,); and its own keypoints.

    space : (P, 3) m, axes as in :class:`NetworkKeypoints`; None = the network does not give it
    """

    xy: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    network: NetworkKeypoints
    space: np.ndarray | None = None

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
        box: np.ndarray = np.concatenate([xy.min(axis=0), xy.max(axis=0)])
        return box

    def box(self, least: float = _SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the person with these joints; None as for :meth:`extent`."""
        joints = self.extent(least, share)
        return None if joints is None else joints + _MARGIN * (joints[2:] - joints[:2]).max() * np.array([-1, -1, 1, 1])

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
        space = None if keypoints.space is None else self.joint_map.weights @ keypoints.space.astype(float)
        return BodyPose(*joints, keypoints, space)


def shadow_share(image: np.ndarray, box: np.ndarray) -> float:
    """Share of what is in a box and differs from the ground around it that is only darker, as a shadow.

    image : (H, W, 3) uint8 BGR; box : (4,) px x_min y_min x_max y_max
    """
    import cv2

    size = np.array([image.shape[1], image.shape[0]])
    extent = np.asarray(box[2:], float) - box[:2]
    low = np.clip(np.floor(box[:2] - _AROUND * extent), 0, size).astype(int)
    high = np.clip(np.ceil(box[2:] + _AROUND * extent), 0, size).astype(int)
    if (high - low).min() < 8:
        return 0.0
    view = image[low[1] : high[1], low[0] : high[0]]
    patch = cv2.resize(view, (_PATCH_PX, _PATCH_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
    scale = _PATCH_PX / (high - low)
    x0, y0, x1, y1 = np.round(((np.asarray(box, float).reshape(2, 2) - low) * scale).ravel()).astype(int)
    inside = np.zeros((_PATCH_PX, _PATCH_PX), bool)
    inside[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = True
    if inside.all() or not inside.any():
        return 0.0
    ground = np.median(patch[~inside], axis=0)
    ratio = patch[inside] / np.maximum(ground, 8.0)
    mean, spread = ratio.mean(axis=1), np.ptp(ratio, axis=1)
    different = (np.abs(ratio - 1.0) > _DIFFERENT).any(axis=1)
    if different.mean() < _LEAST_DIFFERENT:
        return 0.0
    shadow = (mean > _SHADOW[0]) & (mean < _SHADOW[1]) & (spread < _TINT)
    return float((shadow & different).sum() / different.sum())


def without_shadow(confidence: float, image: np.ndarray, box: np.ndarray) -> float:
    """Confidence in a person of a pose of this mean confidence, found in a box (4,) px, less what its shadow takes."""
    return confidence - _PENALTY * max(0.0, shadow_share(image, box) - 0.5) / (1 - 0.5)
