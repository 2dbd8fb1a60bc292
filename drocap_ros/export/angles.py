"""Joint angles of the fitted rigid body, after the recommendations of the ISB (Wu 2002, 2005).

Segment axes: X forwards, Y up, Z to the right; left joints are mirrored, so that both sides have the same signs.  Hip
and trunk: Cardan angles Z X Y of the distal segment.  Shoulder: Euler angles Y X Y.  Pelvis: Y X Z relative to the
world (Baker 2001), because the person may face any way.  Positions do not show the tilt of the pelvis on its own (it
follows the trunk), nor pronation, nor the rotation of the shank.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from drocap_ros.export.measured import write_table
from drocap_ros.export.rig import body_of, least_rotation
from drocap_ros.export.rigid_body import RigidBody
from drocap_ros.export.take import Take, y_up
from drocap_ros.skeleton import TOES

#: Columns: ISB axes X, Y, Z in the axes of the rigid body (x left, y up, z forwards).
_ISB = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
_MIRROR = np.diag([1.0, 1.0, -1.0])
#: Standard deviation in time of the axial rotation of thigh and upper arm, s.
_AXIAL_S = 0.2
#: Flexion at which the plane of knee or elbow counts as much as no axial rotation, degrees.
_CLEAR_DEG = 15.0


def write_csv_angles(path: Path, take: Take) -> tuple[str, ...]:
    """Write a table: ``time_s``, ``frame`` (from 0), and a column ``NAME_deg`` per joint angle; returns notes."""
    take = y_up(take)
    body, notes = body_of(take)
    angles = joint_angles(body, take.rate_hz)
    write_table(path, take.times_s, [f"{name}_deg" for name in angles], np.stack(list(angles.values()), axis=1))
    return notes


def joint_angles(body: RigidBody, rate_hz: float) -> dict[str, np.ndarray]:
    """Name -> (F,) degrees, continuous over time, signs as in docs/export.md.

    Parameters
    ----------
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
    upper, lower = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-9) for v in (upper, lower))
    axes = least_rotation(np.array([0.0, -1.0, 0.0]), upper, rate_hz).as_matrix()
    bent = bends * _in(axes, lower)
    # Weighted by the squared sine of the flexion, in the complex plane of X and -Z.
    plane = (bent[:, 0] - 1j * bent[:, 2]) * np.abs(bent[:, 0] - 1j * bent[:, 2])
    # The bound keeps invalid stamps (a counter for nanoseconds) from a kernel of 10^9 taps.
    sigma = min(max(_AXIAL_S * rate_hz, 1e-3), 1000.0)
    smooth = gaussian_filter1d(plane.real, sigma) + 1j * gaussian_filter1d(plane.imag, sigma)
    turn = np.unwrap(np.angle(smooth + np.sin(np.radians(_CLEAR_DEG)) ** 2))
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
