"""2D pose: the crop around a person, decoding of every layout, uncertainty."""

from drocap_ros.perception.pose.keypoints import Keypoints
from drocap_ros.perception.pose.model import PoseModel

__all__ = ["Keypoints", "PoseModel"]
