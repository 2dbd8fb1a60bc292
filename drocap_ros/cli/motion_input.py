"""The MOTION argument: a motion file, or its folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

HELP = "motion.npz, or its folder"


def read_motion(argument: Path) -> tuple[Path, Motion]:
    """Path and content of the motion file of an argument.

    Raises
    ------
    InputError
        When it is not a motion.
    """
    from drocap_ros.motion import load_motion, motion_file

    path = motion_file(argument)
    return path, load_motion(path)
