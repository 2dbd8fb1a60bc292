"""Measured positions and joint angles: C3D and TRC (millimetres, constant rate), CSV (metres, own stamps).

Unknown joints stay unknown: residual -1 in C3D, ``nan`` in TRC, an empty cell in CSV.

Joint angles of the fitted rigid body follow the recommendations of the ISB (Wu 2002, 2005).  Segment axes: X forwards,
Y up, Z to the right; left joints are mirrored, so that both sides have the same signs.  Hip and trunk: Cardan angles Z
X Y of the distal segment.  Shoulder: Euler angles Y X Y.  Pelvis: Y X Z relative to the world (Baker 2001), because the
person may face any way.  Positions do not show the tilt of the pelvis on its own (it follows the trunk), nor pronation,
nor the rotation of the shank.
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from drocap_ros.errors import InputError
from drocap_ros.export.rig import body_of, least_rotation
from drocap_ros.export.rigid_body import RigidBody
from drocap_ros.export.take import Take, at_constant_rate, y_up
from drocap_ros.geometry.alignment import directions
from drocap_ros.skeleton import TOES

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
    points[..., :3] = np.where(known[..., None], 1000.0 * take.positions, 0.0)
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
    table = np.column_stack([numbers + 1, numbers / take.rate_hz, 1000.0 * take.positions.reshape(frames, -1)])
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


#: Columns: ISB axes X, Y, Z in the axes of the rigid body (x left, y up, z forwards).
_ISB = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
_MIRROR = np.diag([1.0, 1.0, -1.0])


#: Bends (degrees) that no body has, beyond the widest ranges of healthy people: an error of the motion.
_POSSIBLE = {"knee_flexion": (-20.0, 165.0), "elbow_flexion": (-20.0, 165.0), "hip_flexion": (-60.0, 150.0)}


def write_csv_angles(path: Path, take: Take, deviations: Mapping[str, np.ndarray]) -> tuple[str, ...]:
    """Write a table: ``time_s``, ``frame`` (from 0), ``NAME_deg``, ``NAME_sd_deg``, ``possible``; returns notes.

    deviations : knee, hip, elbow -> (F, 2) degrees, right and left
    """
    take = y_up(take)
    body, notes = body_of(take)
    angles = joint_angles(body, take.rate_hz)
    columns = {f"{name}_deg": values for name, values in angles.items()}
    for joint, both in deviations.items():
        columns |= {f"{side}_{joint}_flexion_sd_deg": both[:, at] for at, side in enumerate(("right", "left"))}
    possible = np.ones(len(take.times_s), bool)
    for name, (low, high) in _POSSIBLE.items():
        for side in ("right", "left"):
            angle = angles[f"{side}_{name}"]
            beyond = (angle < low) | (angle > high)
            possible &= ~beyond
            if beyond.any():
                worst = int(np.abs(np.where(beyond, angle, 0.0)).argmax())
                where = f"{angle[worst]:.0f} degrees at {take.times_s[worst]:.2f} s"
                notes = (*notes, f"{side} {name.replace('_', ' ')} that no body has: {where}, {beyond.sum()} frames")
    columns["possible"] = possible.astype(float)
    write_table(path, take.times_s, list(columns), np.stack(list(columns.values()), axis=1))
    return notes


def joint_angles(body: RigidBody, rate_hz: float) -> dict[str, np.ndarray]:
    """Name -> (F,) degrees, continuous over time, signs as in docs/export.md.

    rate_hz : frames per second
    """
    pelvis, chest = body.pelvis @ _ISB, body.chest @ _ISB
    rotation, list_, tilt = continuous_euler(pelvis, "YXZ").T
    flexion, bending, axial = continuous_euler(np.swapaxes(pelvis, 1, 2) @ chest, "ZXY").T
    out = {"pelvis_rotation": rotation, "pelvis_obliquity": list_, "pelvis_tilt": -tilt}
    out |= {"trunk_flexion": -flexion, "trunk_bending": bending, "trunk_rotation": axial}
    head = _in(chest, body.at("head") - body.at("neck"))
    out["head_flexion"] = _angle(head[:, 0], head[:, 1])
    out["head_bending"] = _angle(head[:, 2], np.hypot(head[:, 0], head[:, 1]))
    for side, letter in (("right", "r"), ("left", "l")):
        out |= {f"{side}_{name}": values for name, values in _leg(body, pelvis, letter, rate_hz).items()}
        out |= {f"{side}_{name}": values for name, values in _arm(body, chest, letter, rate_hz).items()}
    return out


def _leg(body: RigidBody, pelvis: np.ndarray, side: str, rate_hz: float) -> dict[str, np.ndarray]:
    hip, knee, ankle = (_in(pelvis, body.at(side + name), side) for name in ("hip", "knee", "ankle"))
    thigh, shank = _limb(knee - hip, ankle - knee, -1.0, rate_hz)
    flexion, adduction, rotation = continuous_euler(thigh, "ZXY").T
    bend, aside = _angle(-shank[:, 0], -shank[:, 1]), np.degrees(np.arcsin(np.clip(-shank[:, 2], -1, 1)))
    out = {"hip_flexion": flexion, "hip_adduction": adduction, "hip_rotation": rotation}
    out |= {"knee_flexion": bend, "knee_adduction": aside}
    if set(TOES) <= set(body.joints):
        foot = _in(thigh, _in(pelvis, body.at(side + "toe"), side) - ankle)
        # Across the shank, in the plane of the knee.
        forwards = np.stack([-shank[:, 1], shank[:, 0], np.zeros(len(shank))], axis=1)
        out["ankle_dorsiflexion"] = _angle(-np.sum(foot * shank, axis=1), np.sum(foot * forwards, axis=1))
    return out


def _arm(body: RigidBody, chest: np.ndarray, side: str, rate_hz: float) -> dict[str, np.ndarray]:
    shoulder, elbow, wrist = (_in(chest, body.at(side + name), side) for name in ("shoulder", "elbow", "wrist"))
    upper, fore = _limb(elbow - shoulder, wrist - elbow, 1.0, rate_hz)
    plane, elevation, rotation = continuous_euler(upper, "YXY").T
    return {
        "shoulder_plane": plane,
        "shoulder_elevation": -elevation,
        "shoulder_rotation": rotation,
        "elbow_flexion": _angle(fore[:, 0], -fore[:, 1]),
    }


def _limb(upper: np.ndarray, lower: np.ndarray, bends: float, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) axes of the upper bone and (F, 3) unit direction of the lower one in them.

    The upper bone hangs along -Y and has the smallest rotation, then an axial one that brings the lower bone into the
    plane X Y, towards X times ``bends``; the straighter the limb, the less it is turned.
    """
    upper, lower = directions(upper), directions(lower)
    axes = least_rotation(np.array([0.0, -1.0, 0.0]), upper, rate_hz).as_matrix()
    bent = bends * _in(axes, lower)
    # Weighted by the squared sine of the flexion, in the complex plane of X and -Z.
    plane = (bent[:, 0] - 1j * bent[:, 2]) * np.abs(bent[:, 0] - 1j * bent[:, 2])
    # The bound keeps invalid stamps (a counter for nanoseconds) from a kernel of 10^9 taps.
    # Standard deviation in time of the axial rotation of thigh and upper arm, s.
    sigma = min(max(0.2 * rate_hz, 1e-3), 1000.0)
    smooth = gaussian_filter1d(plane.real, sigma) + 1j * gaussian_filter1d(plane.imag, sigma)
    # Flexion at which the plane of knee or elbow counts as much as no axial rotation, degrees.
    turn = np.unwrap(np.angle(smooth + np.sin(np.radians(15.0)) ** 2))
    axes = axes @ Rotation.from_rotvec(turn[:, None] * (0.0, 1.0, 0.0)).as_matrix()
    return axes, _in(axes, lower)


def _in(axes: np.ndarray, vectors: np.ndarray, side: str = "r") -> np.ndarray:
    """(F, 3) vectors in the coordinates of axes (F, 3, 3); mirrored to the right for the left side."""
    local = np.einsum("fji,fj->fi", axes, vectors)
    return np.asarray(local @ _MIRROR if side == "l" else local)


def _angle(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(F,) degrees in [-90, 270): no limb bends backwards by a right angle, so the cut is never crossed."""
    return np.asarray(np.degrees((np.arctan2(y, x) + 0.5 * np.pi) % (2.0 * np.pi) - 0.5 * np.pi))


def continuous_euler(rotations: np.ndarray, order: str) -> np.ndarray:
    """(F, 3) degrees about moving axes; of the two solutions per frame the one nearer to the previous frame's."""
    first = Rotation.from_matrix(rotations).as_euler(order)
    proper = order[0] == order[2]
    if proper:
        first = first * (1.0, -1.0, 1.0) + (np.pi, 0.0, np.pi)
    second = first * (1.0, -1.0, 1.0) + (np.pi, 0.0 if proper else np.pi, np.pi)

    def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.sum(np.abs(np.angle(np.exp(1j * (a - b)))), axis=1))

    crossed = apart(first[1:], second[:-1]) < apart(first[1:], first[:-1])
    swapped = np.concatenate([[False], np.cumsum(crossed) % 2 == 1])
    angles = np.unwrap(np.where(swapped[:, None], second, first), axis=0)
    # The first frame lies within half a turn.
    return np.asarray(np.degrees(angles - 2.0 * np.pi * np.round(angles[0] / (2.0 * np.pi))))
