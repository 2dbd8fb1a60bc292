"""Motions in the formats of other tools (docs/export.md): BVH, C3D, TRC, CSV, glTF, USD, FBX, angles, OpenSim."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from drocap_ros.errors import InputError

if TYPE_CHECKING:
    from drocap_ros.motion import Motion

#: Format -> units and up axis of its files.
FORMATS = {
    "bvh": "centimetres, y up",
    "c3d": "millimetres, z up",
    "trc": "millimetres, y up",
    "csv": "metres, z up",
    "csv-angles": "joint angles, degrees",
    "glb": "metres, y up",
    "mot": "OpenSim coordinates, degrees and metres, y up",
    "usd": "metres, y up",
    "fbx": "metres, by Blender",
}
#: Formats with an animation skeleton: names of its joints and its rest pose can be chosen.
RIGGED = ("bvh", "glb", "usd", "fbx")
#: Formats of measured positions; the others need a pose in each frame.
MEASURED = ("c3d", "trc", "csv")


def export(
    motion: Motion | str | Path,
    path: str | Path,
    form: str | None = None,
    *,
    names: str | None = None,
    rest: str | None = None,
    smooth_hz: float | None = None,
    lock_feet: bool = False,
) -> tuple[str, ...]:
    """Write a motion, or the motion of a file or folder, to a file of another format.

    form : one of :data:`FORMATS`; None: the ending of ``path``
    names : joint names of rigs, one of :data:`drocap_ros.export.rig.NAMES`; None: "h36m"
    rest : rest pose of rigs, one of :data:`drocap_ros.export.rig.RESTS`; None: "t"
    smooth_hz : cut-off of :func:`drocap_ros.export.take.smooth`; None: no filter
    lock_feet : :func:`drocap_ros.export.take.lock_feet`, after the filter
    returns : notes on changes, as sentences: frames without the person, resampling, interpolation, cleaning,
        constant bones, floor, unknown vertical
    """
    from drocap_ros.export import take as preparation
    from drocap_ros.export.animation import write_bvh, write_glb
    from drocap_ros.export.measured import write_c3d, write_csv, write_csv_angles, write_trc
    from drocap_ros.export.opensim import write_mot
    from drocap_ros.export.usd import write_fbx, write_usd
    from drocap_ros.motion import Motion, load_motion
    from drocap_ros.report.movement import bend_deviations

    whole = motion if isinstance(motion, Motion) else load_motion(motion)
    writers: dict[str, Callable[..., tuple[str, ...]]] = {
        "bvh": write_bvh,
        "c3d": write_c3d,
        "trc": write_trc,
        "csv": write_csv,
        "csv-angles": lambda path, take: write_csv_angles(path, take, bend_deviations(whole)),
        "glb": write_glb,
        "mot": write_mot,
        "usd": functools.partial(write_usd, motion=whole),
        "fbx": write_fbx,
    }
    form = form or Path(path).suffix[1:]
    if form not in writers:
        raise InputError(f"format: expected one of {', '.join(FORMATS)}, got {form!r}")
    chosen = {name: value for name, value in (("names", names), ("rest", rest)) if value is not None}
    if chosen and form not in RIGGED:
        raise InputError(f"{', '.join(chosen)}: expected with format {' or '.join(RIGGED)}, got {form}; leave it out")
    take = preparation.take_of(whole, measured=form in MEASURED)
    if smooth_hz is not None:
        take = preparation.smooth(take, smooth_hz)
    if lock_feet:
        take = preparation.lock_feet(take)
    return writers[form](Path(path), take, **chosen)


class _CallableModule(ModuleType):
    """``drocap_ros.export`` is a function for users and this room; an import of the room would hide the function."""

    __call__ = staticmethod(export)


sys.modules[__name__].__class__ = _CallableModule
