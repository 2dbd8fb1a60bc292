"""The MOTION argument: a motion file, or the folder that holds one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

HELP = "motion.npz, or the folder that holds it"


def read_motion(argument: Path) -> tuple[Path, Motion]:
    """The file that an argument names, and the motion in it.

    Raises
    ------
    InputError
        When it is no motion.
    """
    from drocap_ros.motion import load_motion

    path = argument / "motion.npz" if argument.is_dir() else argument
    return path, load_motion(path)
