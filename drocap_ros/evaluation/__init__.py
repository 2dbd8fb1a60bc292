"""Accuracy: error measures, comparison of a motion with its truth, studies over MoCap.  No ROS."""
