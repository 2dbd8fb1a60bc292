"""BVH: a hierarchy with constant bones, rotations per frame; y up, centimetres, degrees.

A joint with several children has a zero-length joint before each of them (``pelvis_to_rhip``), as in the CMU files:
hips, spine and shoulders then rotate independently, and every bone keeps its direction.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drocap_ros.export.clip import Clip, at_constant_rate, without_gaps, y_up
from drocap_ros.export.rig import Rig, fit_rig

_CM = 100.0
#: Length of the end site along the bone, so that importers draw the last joint.
_END_CM = 5.0
_FORMAT = "%.5f"


def write_bvh(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a BVH file; returns notes on changes.

    Parameters
    ----------
    clip : z-up; it is resampled to a constant rate, and its gaps are interpolated

    Raises
    ------
    InputError
        When a joint is never known.
    """
    clip = without_gaps(y_up(at_constant_rate(clip)))
    rig = fit_rig(clip.positions, clip.joints, clip.parents, clip.rate_hz)
    lines: list[str] = ["HIERARCHY"]
    columns: list[np.ndarray] = []
    _joint(lines, columns, rig, clip, rig.order[0], 0)
    values = np.concatenate(columns, axis=1)
    with path.open("w", encoding="ascii", newline="\n") as out:
        out.write("\n".join(lines))
        out.write(f"\nMOTION\nFrames: {len(values)}\nFrame Time: {1.0 / clip.rate_hz:.9f}\n")
        np.savetxt(out, values, fmt=_FORMAT)
    posed = rig.positions(clip.positions[:, rig.order[0]], clip.parents)
    off = 1000.0 * np.linalg.norm(posed - clip.positions, axis=2)
    constant = f"bones made constant: joints moved by {off.mean():.1f} mm on average, at most {off.max():.1f} mm"
    return (*clip.notes, constant)


def _joint(lines: list[str], columns: list[np.ndarray], rig: Rig, clip: Clip, joint: int, depth: int) -> None:
    """Append the lines and motion columns of a joint and all its descendants."""
    name, parent = clip.joints[joint], clip.parents[joint]
    children = [c for c in rig.order if clip.parents[c] == joint]
    above = rig.aimed[joint]
    offset = rig.offsets[joint] * _CM
    if parent < 0:
        _open(lines, "ROOT", name, offset, depth, "Xposition Yposition Zposition ")
        columns.append(clip.positions[:, joint] * _CM)
        above = Rotation.identity(len(clip.positions))
    else:
        _open(lines, "JOINT", name, offset, depth)
    columns.append(_angles(above.inv() * rig.turned[joint]))
    for child in children:
        if len(children) == 1:
            _joint(lines, columns, rig, clip, child, depth + 1)
            continue
        _open(lines, "JOINT", f"{name}_to_{clip.joints[child]}", np.zeros(3), depth + 1)
        columns.append(_angles(rig.turned[joint].inv() * rig.aimed[child]))
        _joint(lines, columns, rig, clip, child, depth + 2)
        lines.append("\t" * (depth + 1) + "}")
    if not children:
        stub = offset / max(float(np.linalg.norm(offset)), 1e-9) * _END_CM
        inner = "\t" * (depth + 1)
        lines += [f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_numbers(stub)}", f"{inner}}}"]
    lines.append("\t" * depth + "}")


def _open(lines: list[str], kind: str, name: str, offset: np.ndarray, depth: int, position: str = "") -> None:
    outer, count = "\t" * depth, 6 if position else 3
    lines += [
        f"{outer}{kind} {name}",
        f"{outer}{{",
        f"{outer}\tOFFSET {_numbers(offset)}",
        f"{outer}\tCHANNELS {count} {position}Zrotation Xrotation Yrotation",
    ]


def _numbers(values: np.ndarray) -> str:
    return " ".join(_FORMAT % v for v in values + 0.0)


def _angles(rotation: Rotation) -> np.ndarray:
    """(F, 3) degrees about z, x, y, applied from the last to the first, without jumps of a whole turn."""
    return np.degrees(np.unwrap(rotation.as_euler("ZXY"), axis=0))
