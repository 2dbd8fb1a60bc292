"""Calibrated keypoints of one body in one image, its feet by a second network, the shadow that it may be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.pose.pose_model import NetworkKeypoints, PoseModel
from drocap_ros.skeleton import BODY_15, BODY_19, indices, joint_map


@dataclass(frozen=True)
class Calibration:
    """Calibration of one kind of output.

    scores, sigmas : knots of the standard deviation over the peak's height, in shares of the box's longer side
    spread_share : share of the measured spread (px^2) that adds to the variance
    intercept, per_score, per_second_peak, per_spread : logistic regression of the confidence on the peak's height,
        the second peak's height and ten times the spread's standard deviation over the box
    """

    sigmas: tuple[float, ...]
    spread_share: float
    intercept: float
    per_score: float
    per_second_peak: float = 0.0
    per_spread: float = 0.0
    scores: tuple[float, ...] = (0.0, 0.3, 0.5, 0.65, 0.75, 0.85, 0.95)


#: Fitted with PP-TinyPose and MoveNet Lightning.  SimCC and one-stage models use the most similar kind's constants: the
#: fit had no weights of theirs.
CALIBRATIONS: dict[str, Calibration] = {
    "heatmap": Calibration(
        (0.0444, 0.0316, 0.0282, 0.0282, 0.0282, 0.0134, 0.0099), 0.25, -1.543, 6.847, -4.887, -0.997
    ),
    "simcc": Calibration((0.0444, 0.0316, 0.0282, 0.0282, 0.0282, 0.0134, 0.0099), 0.25, -1.543, 6.847),
    "movenet": Calibration((0.0494, 0.0244, 0.0221, 0.0201, 0.0173, 0.0169, 0.0129), 0.0, -0.969, 7.309),
}
_ONE_STAGE = CALIBRATIONS["movenet"]

#: Least standard deviation, px: the pixel grid.
_FLOOR_PX = 0.3


def calibrate(keypoints: NetworkKeypoints, layout: str, sigma_scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and confidence of one person's keypoints.

    keypoints : P joints
    layout : of the pose model's outputs
    sigma_scale : standard deviations of this model over those of the models of the fit

    Returns
    -------
    covariance (P, 3) px^2, xx xy yy; confidence (P,) in [0, 1]
    """
    c = CALIBRATIONS.get(layout, _ONE_STAGE)
    score = keypoints.score.astype(float)
    spread = np.nan_to_num(keypoints.spread.astype(float))
    variance = (np.interp(score, c.scores, c.sigmas) * keypoints.box_size) ** 2
    covariance = sigma_scale**2 * (c.spread_share * spread + variance[:, None] * np.array([1.0, 0.0, 1.0]))
    covariance += _FLOOR_PX**2 * np.array([1.0, 0.0, 1.0])
    second_peak = keypoints.second.astype(float)
    width = np.sqrt((spread[:, 0] + spread[:, 2]) / 2) / max(keypoints.box_size, 1.0)
    logit = c.intercept + c.per_score * score + c.per_second_peak * second_peak + c.per_spread * 10.0 * width
    return covariance, 1.0 / (1.0 + np.exp(-np.clip(logit, -30, 30)))


_ANKLES = indices(BODY_19.joints, ("rankle", "lankle"))
#: Toe and heel of each side.
_FEET = np.array([indices(BODY_19.joints, (f"{side}toe", f"{side}heel")) for side in "rl"])
#: Distance of both networks' ankles, share of the body's longer extent, from which they see different legs: a shank is
#: 0.22 of it, and the errors of either network are below 0.03.
_SAME_ANKLE = 0.1


class FeetModel:
    """A pose network that serves for the feet alone."""

    def __init__(self, model: PoseModel) -> None:
        self._body = BodyPoseModel(model)
        if self._body.joint_map.joints is not BODY_19:
            raise InputError(
                f"{model.model.path}: expected a network with toes and heels (coco21, halpe26, wholebody133), found"
                f" {model.joints.name}; name another for the feet"
            )

    def add(self, image: np.ndarray, box: np.ndarray, pose: BodyPose) -> BodyPose:
        """The pose with ``BODY_19``: a foot where both networks see its ankle in one place, else it is not seen.

        image : (H, W, 3) uint8 BGR
        box : (4,) px of the person, where the joints of ``pose`` give none
        """
        extent, around = pose.extent(), pose.box()
        seen = self._body.estimate(image, box if around is None else around)
        count = len(BODY_19)
        xy, covariance, confidence = np.full((count, 2), np.nan), np.full((count, 3), np.nan), np.zeros(count)
        for ours, theirs in ((xy, pose.xy), (covariance, pose.covariance), (confidence, pose.confidence)):
            ours[: len(BODY_15)] = theirs[: len(BODY_15)]
        if extent is None:
            return BodyPose(xy, covariance, confidence, pose.network)
        gap = np.linalg.norm(pose.xy[_ANKLES][:, None] - seen.xy[_ANKLES], axis=-1)
        # From the side networks exchange legs: a foot belongs to the leg whose ankle it has.
        crossed = gap[0, 1] + gap[1, 0] < gap[0, 0] + gap[1, 1]
        most = _SAME_ANKLE * float((extent[2:] - extent[:2]).max())
        for side in (0, 1):
            other = 1 - side if crossed else side
            if gap[side, other] < most:
                xy[_FEET[side]] = seen.xy[_FEET[other]]
                covariance[_FEET[side]] = seen.covariance[_FEET[other]]
                confidence[_FEET[side]] = seen.confidence[_FEET[other]]
        return BodyPose(xy, covariance, confidence, pose.network, None if crossed else seen.space)


CLEAR_CONFIDENCE = 0.8  # mean confidence of a clear pose; persons in bad light or from steeply above have 0.5 to 0.9
LEAST_BESIDE = (
    0.6  # least confidence of a joint in another's box, too: of the own ones 5 % have less, of others' the half
)
SEEN = 0.3  # least confidence of a joint, and mean of a pose, that count: boxes without a person hardly have more
SAME_JOINTS = 0.05  # median distance of one person's joints in two boxes, share of the body's longer extent
BOX_MARGIN = 0.06  # of a person's box around the joints, share of their longer extent: head and feet
_PATCH_PX = 32  # side of the patch in which a shadow is sought
_AROUND = 0.3  # margin around the box that shows the ground, share of its sides
#: Brightness of a shadow over that of the ground, sRGB: sun and sky over sky alone; black clothes are darker.
_DARKEST = 0.3
#: Least difference from the ground of what stands or lies on it, also of a shadow, and the largest between the ratios
#: of its channels, as skylight makes it bluer; shares of the brightness.
_DIFFERENT = 0.15
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

    def extent(self, least: float = SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the joints; None when fewer than a share of ``BODY_15`` are seen with the least confidence."""
        seen = self.confidence[: len(BODY_15)] >= least
        if seen.sum() < share * len(seen):
            return None
        xy = self.xy[: len(BODY_15)][seen]
        box: np.ndarray = np.concatenate([xy.min(axis=0), xy.max(axis=0)])
        return box

    def box(self, least: float = SEEN, share: float = 0.7) -> np.ndarray | None:
        """(4,) px box of the person with these joints; None as for :meth:`extent`."""
        joints = self.extent(least, share)
        return (
            None if joints is None else joints + BOX_MARGIN * (joints[2:] - joints[:2]).max() * np.array([-1, -1, 1, 1])
        )

    def limbs(self) -> np.ndarray:
        """(14,) px, lengths in the image of what joins the joints of ``BODY_15``; NaN where one is not seen."""
        xy = np.where(self.confidence[:, None] >= SEEN, self.xy, np.nan)[: len(BODY_15)]
        return np.asarray(np.linalg.norm(xy[1:] - xy[list(BODY_15.parents[1:])], axis=1))

    def belief(self, image: np.ndarray, box: np.ndarray) -> float:
        """Confidence that the box (4,) px of this pose shows a person; shadow in the box reduces it."""
        confidence = self.mean_confidence
        return confidence if confidence >= CLEAR_CONFIDENCE else without_shadow(confidence, image, box)

    def same_person(self, other: BodyPose) -> bool:
        """Whether two boxes of one image gave the joints of one person."""
        seen = np.minimum(self.confidence, other.confidence)[: len(BODY_15)] >= SEEN
        if seen.sum() < 0.5 * len(seen):
            return False
        xy = other.xy[: len(BODY_15)][seen]
        apart = np.linalg.norm(self.xy[: len(BODY_15)][seen] - xy, axis=1)
        return bool(np.median(apart) < SAME_JOINTS * np.ptp(xy, axis=0).max())


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
    shadow = (mean > _DARKEST) & (mean < 1 - _DIFFERENT) & (spread < _DIFFERENT)
    return float((shadow & different).sum() / different.sum())


def without_shadow(confidence: float, image: np.ndarray, box: np.ndarray) -> float:
    """Confidence in a person of a pose of this mean confidence, found in a box (4,) px, less what its shadow takes."""
    return confidence - _PENALTY * max(0.0, shadow_share(image, box) - 0.5) / (1 - 0.5)
