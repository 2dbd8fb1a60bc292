"""CSV: one row per frame with its own stamp; positions (metres, z up, empty where unknown) or joint angles."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drocap_ros.export.angles import joint_angles
from drocap_ros.export.clip import Clip, y_up
from drocap_ros.export.rig import body_of

_BLOCK = 10_000


def write_csv(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a table with the columns ``time_s``, ``frame`` (from 0), and ``NAME_x_m``, ``_y_m``, ``_z_m`` per joint."""
    columns = [f"{joint}_{axis}_m" for joint in clip.joints for axis in "xyz"]
    _write(path, clip.times_s, columns, clip.positions.reshape(len(clip.positions), -1))
    return clip.notes


def write_csv_angles(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a table with the columns ``time_s``, ``frame`` (from 0), and ``NAME_deg`` per joint angle; returns notes.

    Raises
    ------
    InputError
        When a joint of ``BODY_15`` is missing or never known.
    """
    clip = y_up(clip)
    body, notes = body_of(clip)
    angles = joint_angles(body, clip.rate_hz)
    _write(path, clip.times_s, [f"{name}_deg" for name in angles], np.stack(list(angles.values()), axis=1))
    return notes


def _write(path: Path, times_s: np.ndarray, columns: list[str], flat: np.ndarray) -> None:
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["time_s", "frame", *columns])
        for first in range(0, len(flat), _BLOCK):
            block = flat[first : first + _BLOCK]
            text = np.where(np.isfinite(block), np.char.mod("%.6f", block), "")
            times = np.char.mod("%.9f", times_s[first : first + _BLOCK])
            frames = np.arange(first, first + len(block)).astype(str)
            writer.writerows(np.column_stack([times, frames, text]).tolist())
