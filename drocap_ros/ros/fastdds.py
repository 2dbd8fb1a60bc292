"""Fast DDS profile of a graph's processes; another middleware, and a profile that the user has set, are left alone."""

from __future__ import annotations

import os
from pathlib import Path

import rclpy

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_DATA = Path(__file__).parents[1] / "data"


def environment() -> dict[str, str]:
    """Environment variables by which a process uses our profile; read when its first node is created."""
    if PROFILE_VARIABLE in os.environ or not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"):
        return {}
    if os.environ.get(RANGE_VARIABLE) == "LOCALHOST":
        # The profile restricts the range; ROS's own restriction would add shared memory.
        return {RANGE_VARIABLE: "SYSTEM_DEFAULT", PROFILE_VARIABLE: str(_DATA / "fastdds_localhost.xml")}
    return {PROFILE_VARIABLE: str(_DATA / "fastdds.xml")}
