"""C3D, the file of motion capture laboratories: millimetres, z up, constant rate, residual -1 where unknown."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.export.clip import Clip, at_constant_rate

_MM = 1000.0
#: The format counts frames in 16 bits; readers differ in longer files.
_MAX_FRAMES = 65_535


def write_c3d(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a C3D file of a z-up clip; returns notes on changes.

    Raises
    ------
    InputError
        When there are more than 65,535 frames.
    """
    import c3d

    clip = at_constant_rate(clip)
    frames, joints = clip.positions.shape[:2]
    if frames > _MAX_FRAMES:
        raise InputError(
            f"motion: expected at most {_MAX_FRAMES} frames in a C3D file, got {frames}; cut it or use trc"
        )
    known = np.isfinite(clip.positions).all(axis=2)
    # Columns of a point: x, y, z, residual (0 = no estimate of the error, -1 = not measured), camera mask.
    points = np.zeros((frames, joints, 5), np.float32)
    points[..., :3] = np.where(known[..., None], _MM * clip.positions, 0.0)
    points[..., 3] = np.where(known, 0.0, -1.0)
    writer = c3d.Writer(point_rate=clip.rate_hz, point_units="mm")
    writer.set_point_labels(clip.joints)
    writer.set_screen_axis(X="+X", Y="+Z")
    no_analog = np.zeros((0, 0), np.float32)
    writer.add_frames([(frame, no_analog) for frame in points])
    with path.open("wb") as out, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library warns that there is no analogue data
        writer.write(out)
    return clip.notes
