"""The MOTION argument: a motion file, or its folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

HELP = "motion.npz, or its folder"
FILE = "motion.npz"
TRUTH = "truth.npz"


def read_motion(argument: Path) -> tuple[Path, Motion]:
    """Path and content of the motion file of an argument.

    Raises
    ------
    InputError
        When it is not a motion.
    """
    from drocap_ros.motion import load_motion

    path = motion_path(argument)
    return path, load_motion(path)


def motion_path(argument: Path, *names: str) -> Path:
    """File of an argument: itself, or in a folder the first of ``names`` and ``motion.npz`` that exists.

    Raises
    ------
    InputError
        When the folder holds none of them.
    """
    if not argument.is_dir():
        return argument
    for name in (*names, FILE):
        if (argument / name).is_file():
            return argument / name
    raise InputError(
        f"{argument / FILE}: no such file; name the folder of a motion, or make one: `drocap reconstruct {argument}`"
    )
