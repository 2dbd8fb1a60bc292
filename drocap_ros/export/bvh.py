"""BVH: a hierarchy with constant bones, rotations per frame; y up, centimetres, degrees."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drocap_ros.export.angles import continuous_euler
from drocap_ros.export.rig import Rig, rig_of
from drocap_ros.export.take import Take, at_constant_rate, y_up

_CM = 100.0  # in a metre
_FORMAT = "%.5f"


def write_bvh(path: Path, take: Take, *, names: str = "h36m", rest: str = "t") -> tuple[str, ...]:
    """Write a BVH file; returns notes on changes.

    Parameters
    ----------
    take : z-up; it is resampled to a constant rate, and its gaps are interpolated
    names, rest : as of :func:`~drocap_ros.export.rig.rig_of`
    """
    take = y_up(at_constant_rate(take))
    rig, notes = rig_of(take, names=names, rest=rest)
    lines: list[str] = ["HIERARCHY"]
    # The root rests where its channels put it, so that a viewer without channels shows a standing person.
    columns = [_CM * rig.root]
    _joint(lines, columns, rig, 0, 0)
    values = np.concatenate(columns, axis=1)
    with path.open("w", encoding="ascii", newline="\n") as out:
        out.write("\n".join(lines))
        out.write(f"\nMOTION\nFrames: {len(values)}\nFrame Time: {1.0 / take.rate_hz:.9f}\n")
        np.savetxt(out, values, fmt=_FORMAT)
    colons = ("three.js animates no name with a colon: --names mixamo-three",) if names == "mixamo" else ()
    return (*notes, *colons)


def _joint(lines: list[str], columns: list[np.ndarray], rig: Rig, joint: int, depth: int) -> None:
    """Append the lines and motion columns of a joint and all its descendants."""
    parent, outer, inner = rig.parents[joint], "\t" * depth, "\t" * (depth + 1)
    offset = rig.rest[joint] - (rig.rest[parent] if parent >= 0 else 0.0)
    channels = "3 " if parent >= 0 else "6 Xposition Yposition Zposition "
    lines += [
        f"{outer}{'JOINT' if parent >= 0 else 'ROOT'} {rig.names[joint]}",
        f"{outer}{{",
        f"{inner}OFFSET {_numbers(offset)}",
        f"{inner}CHANNELS {channels}Zrotation Xrotation Yrotation",
    ]
    columns.append(_channels(rig.local(joint).as_matrix()))
    for child in (c for c, above in enumerate(rig.parents) if above == joint):
        _joint(lines, columns, rig, child, depth + 1)
    if joint in rig.ends:
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_numbers(rig.ends[joint])}", f"{inner}}}"]
    lines.append(outer + "}")


def _channels(rotations: np.ndarray) -> np.ndarray:
    """(F, 3) degrees about Z, X, Y, continuous; a motion that begins in a squat does not keep its half turns."""
    angles = continuous_euler(rotations, "ZXY")
    other = angles * (1.0, -1.0, 1.0) + 180.0
    other -= 360.0 * np.round(other[0] / 360.0)
    return min(angles, other, key=lambda solution: float(np.abs(solution[:, 1]).mean()))


def _numbers(metres: np.ndarray) -> str:
    return " ".join(_FORMAT % v for v in _CM * metres + 0.0)
