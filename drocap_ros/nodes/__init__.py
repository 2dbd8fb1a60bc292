"""The ROS 2 nodes: parameters, conversions, one call into a room, publish."""
