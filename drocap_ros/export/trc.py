"""TRC, the marker file of OpenSim: millimetres, y up, constant rate, ``nan`` where a joint is unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.export.clip import Clip, at_constant_rate, y_up

_MM = 1000.0


def write_trc(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a TRC file of a z-up clip; returns notes on changes."""
    clip = y_up(at_constant_rate(clip))
    frames, joints = clip.positions.shape[:2]
    rate = f"{clip.rate_hz:.9g}"
    names = "\t\t\t".join(clip.joints)
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
    table = np.column_stack([numbers + 1, numbers / clip.rate_hz, _MM * clip.positions.reshape(frames, -1)])
    with path.open("w", encoding="utf-8", newline="\n") as out:
        out.write(header)
        np.savetxt(out, table, fmt=["%d", "%.6f", *["%.4f"] * (3 * joints)], delimiter="\t")
    return clip.notes
