"""2D pose: crop of a person, decoding of each layout."""

from drocap_ros.perception.pose.network_keypoints import NetworkKeypoints
from drocap_ros.perception.pose.pose_model import PoseModel

__all__ = ["NetworkKeypoints", "PoseModel"]
