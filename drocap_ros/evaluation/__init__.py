"""Studies of accuracy: the camera-motion study over MoCap, and one result against its truth.  No ROS."""
