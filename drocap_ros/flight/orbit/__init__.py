"""The orbit: subject position, safety, planner and controller, free of MAVLink bytes and of ROS."""
