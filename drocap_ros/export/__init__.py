"""Motions in the formats of other tools: BVH, C3D, TRC, CSV and binary glTF (``docs/export.md``)."""

from __future__ import annotations

from pathlib import Path
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
    "glb": "metres, y up",
}


def export_motion(motion: Motion, form: str, path: str | Path) -> tuple[str, ...]:
    """Write a motion to a file of another format.

    Parameters
    ----------
    form : one of :data:`FORMATS`

    Returns
    -------
    Notes on changes, as sentences: resampling, interpolation, constant bones, unknown vertical.

    Raises
    ------
    InputError
        When the format is unknown, or the motion has fewer than two frames or lacks data that the format needs.
    """
    from drocap_ros.export.bvh import write_bvh
    from drocap_ros.export.c3d_file import write_c3d
    from drocap_ros.export.clip import clip_of
    from drocap_ros.export.csv_table import write_csv
    from drocap_ros.export.glb import write_glb
    from drocap_ros.export.trc import write_trc

    writers = {"bvh": write_bvh, "c3d": write_c3d, "trc": write_trc, "csv": write_csv, "glb": write_glb}
    if form not in writers:
        raise InputError(f"format: expected one of {', '.join(FORMATS)}, got {form!r}")
    return writers[form](Path(path), clip_of(motion))
