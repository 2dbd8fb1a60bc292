"""Toes and heels, and joints in space, of a body found by one network, as a second network sees them."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.pose.body_pose import BodyPose, BodyPoseModel
from drocap_ros.perception.pose.pose_model import PoseModel
from drocap_ros.skeleton import BODY_15, BODY_19, indices

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
