"""Formats of measured positions: C3D and TRC of laboratories (millimetres, constant rate), CSV (metres, own stamps).

Unknown joints stay unknown: residual -1 in C3D, ``nan`` in TRC, an empty cell in CSV.
"""

from __future__ import annotations

import csv
import warnings
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.export.take import Take, at_constant_rate, y_up

_MM = 1000.0  # in a metre
#: The format counts frames in 16 bits; readers differ in longer files.
_MAX_C3D_FRAMES = 65_535
#: Rows of a CSV file formatted at a time, to bound the memory.
_BLOCK = 10_000


def write_c3d(path: Path, take: Take) -> tuple[str, ...]:
    """Write a C3D file of a z-up take; returns notes on changes."""
    import c3d

    take = at_constant_rate(take)
    frames, joints = take.positions.shape[:2]
    if frames > _MAX_C3D_FRAMES:
        raise InputError(
            f"motion: expected at most {_MAX_C3D_FRAMES} frames in a C3D file, got {frames}; cut it or use trc"
        )
    known = np.isfinite(take.positions).all(axis=2)
    # Columns of a point: x, y, z, residual (0 = no estimate of the error, -1 = not measured), camera mask.
    points = np.zeros((frames, joints, 5), np.float32)
    points[..., :3] = np.where(known[..., None], _MM * take.positions, 0.0)
    points[..., 3] = np.where(known, 0.0, -1.0)
    writer = c3d.Writer(point_rate=take.rate_hz, point_units="mm")
    writer.set_point_labels(take.joints)
    writer.set_screen_axis(X="+X", Y="+Z")
    no_analog = np.zeros((0, 0), np.float32)
    writer.add_frames([(frame, no_analog) for frame in points])
    with path.open("wb") as out, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the library warns that there is no analogue data
        writer.write(out)
    return take.notes


def write_trc(path: Path, take: Take) -> tuple[str, ...]:
    """Write a TRC file of a z-up take; returns notes on changes."""
    take = y_up(at_constant_rate(take))
    frames, joints = take.positions.shape[:2]
    rate = f"{take.rate_hz:.9g}"
    names = "\t\t\t".join(take.joints)
    axes = "\t".join(f"{axis}{number}" for number in range(1, joints + 1) for axis in "XYZ")
    header = (
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}\n"
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
        f"{rate}\t{rate}\t{frames}\t{joints}\tmm\t{rate}\t1\t{frames}\n"
        f"Frame#\tTime\t{names}\t\t\n"
        f"\t\t{axes}\n\n"
    )
    # Times are multiples of the stated rate: readers check one against the other.
    numbers = np.arange(frames)
    table = np.column_stack([numbers + 1, numbers / take.rate_hz, _MM * take.positions.reshape(frames, -1)])
    with path.open("w", encoding="utf-8", newline="\n") as out:
        out.write(header)
        np.savetxt(out, table, fmt=["%d", "%.6f", *["%.4f"] * (3 * joints)], delimiter="\t")
    return take.notes


def write_csv(path: Path, take: Take) -> tuple[str, ...]:
    """Write a table with the columns ``time_s``, ``frame`` (from 0), and ``NAME_x_m``, ``_y_m``, ``_z_m`` per joint."""
    columns = [f"{joint}_{axis}_m" for joint in take.joints for axis in "xyz"]
    write_table(path, take.times_s, columns, take.positions.reshape(len(take.positions), -1))
    return take.notes


def write_table(path: Path, times_s: np.ndarray, columns: list[str], flat: np.ndarray) -> None:
    """Write a CSV file of values (F, N), empty where unknown, at times (F,)."""
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["time_s", "frame", *columns])
        for first in range(0, len(flat), _BLOCK):
            block = flat[first : first + _BLOCK]
            text = np.where(np.isfinite(block), np.char.mod("%.6f", block), "")
            times = np.char.mod("%.9f", times_s[first : first + _BLOCK])
            frames = np.arange(first, first + len(block)).astype(str)
            writer.writerows(np.column_stack([times, frames, text]).tolist())
