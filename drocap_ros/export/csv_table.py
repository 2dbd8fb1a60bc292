"""CSV: one row per frame with its own stamp, metres, z up, empty where a joint is unknown."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from drocap_ros.export.clip import Clip

_BLOCK = 10_000


def write_csv(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a table with the columns ``time_s``, ``frame`` (from 0), and ``NAME_x_m``, ``_y_m``, ``_z_m`` per joint."""
    columns = [f"{joint}_{axis}_m" for joint in clip.joints for axis in "xyz"]
    flat = clip.positions.reshape(len(clip.positions), -1)
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["time_s", "frame", *columns])
        for first in range(0, len(flat), _BLOCK):
            block = flat[first : first + _BLOCK]
            text = np.where(np.isfinite(block), np.char.mod("%.6f", block), "")
            times = np.char.mod("%.9f", clip.times_s[first : first + _BLOCK])
            frames = np.arange(first, first + len(block)).astype(str)
            writer.writerows(np.column_stack([times, frames, text]).tolist())
    return clip.notes
