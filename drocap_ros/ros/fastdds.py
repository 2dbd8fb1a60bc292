"""How Fast DDS, the middleware that ROS comes with, is set for the processes of a graph.

Another middleware, and whoever has a profile of their own, is left alone.
"""

from __future__ import annotations

import os
from pathlib import Path

import rclpy

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
PROFILE_FILE = Path(__file__).parents[1] / "data" / "fastdds.xml"
_RANGE_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
_UDP = "<type>UDPv4</type>"
_SHARED_MEMORY = "<transport_id>shared_memory</transport_id>"


def settings(folder: Path, shared_memory: bool = False) -> dict[str, str]:
    """Environment of a process; writes the profile that it names into ``folder``.

    shared_memory : talk to others that have it through it, as a camera driver's raw pictures, 3 MB and more, need
    """
    if PROFILE_VARIABLE in os.environ or not rclpy.get_rmw_implementation_identifier().startswith("rmw_fastrtps"):
        return {}
    text = PROFILE_FILE.read_text(encoding="utf-8")
    environment = {}
    if os.environ.get(_RANGE_VARIABLE) == "LOCALHOST":
        # ROS's own way to stay on this machine would bring shared memory back.
        environment[_RANGE_VARIABLE] = "SYSTEM_DEFAULT"
        text = text.replace(_UDP, f"{_UDP}<interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList>")
    if shared_memory:
        descriptor = f"<transport_descriptor>{_SHARED_MEMORY}<type>SHM</type></transport_descriptor>"
        text = text.replace("</transport_descriptors>", f"{descriptor}</transport_descriptors>")
        text = text.replace("<userTransports>", f"<userTransports>{_SHARED_MEMORY}")
    path = folder / ("fastdds_shared_memory.xml" if shared_memory else "fastdds.xml")
    if not path.exists():  # processes that were started before may be reading it
        path.write_text(text, encoding="utf-8")
    return {**environment, PROFILE_VARIABLE: str(path)}
