"""2D pose: decoding of each layout, and the calibrated uncertainty of keypoints."""

from drocap_ros.perception.pose.pose_model import NetworkKeypoints, PoseModel

__all__ = ["NetworkKeypoints", "PoseModel"]
