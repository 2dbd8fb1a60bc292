"""A skeleton with constant bones, and its rotations in each frame.

Rest pose: a standing T, y up, facing +z, left at +x.  A joint with one child has the smallest rotation relative to its
parent that brings the child into its measured direction, without twist about the bone, which positions do not show.  A
joint with several children has the rotation that fits their directions best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from drocap_ros.geometry.rotations import project_to_so3

#: Fading time of the twist that keeps a rotation continuous where a bone points against its rest direction.
TWIST_FADE_S = 0.5

#: Direction of each joint from its parent in the rest pose.
_REST = {
    "rhip": (-1, 0, 0), "rknee": (0, -1, 0), "rankle": (0, -1, 0),
    "lhip": (1, 0, 0), "lknee": (0, -1, 0), "lankle": (0, -1, 0),
    "spine": (0, 1, 0), "thorax": (0, 1, 0), "neck": (0, 1, 0), "head": (0, 1, 0),
    "lshoulder": (0.8, -0.6, 0), "lelbow": (1, 0, 0), "lwrist": (1, 0, 0),
    "rshoulder": (-0.8, -0.6, 0), "relbow": (-1, 0, 0), "rwrist": (-1, 0, 0),
}  # fmt: skip


@dataclass(frozen=True)
class Rig:
    """Constant skeleton and its pose in each frame; y up, m.

    order : joints from the root outwards, each after its parent
    offsets : (P, 3) of each joint from its parent in the rest pose (0 at the root)
    turned : per joint, (F,) rotations of its children from the rest pose to the world
    aimed : per joint, (F,) rotations of its own bone from the rest pose to the world
    """

    order: tuple[int, ...]
    offsets: np.ndarray
    turned: tuple[Rotation, ...]
    aimed: tuple[Rotation, ...]

    def positions(self, root: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
        """(F, P, 3) joints of the posed skeleton with its root at ``root`` (F, 3)."""
        out = np.empty((len(root), len(parents), 3))
        for joint in self.order:
            parent = parents[joint]
            out[:, joint] = root if parent < 0 else out[:, parent] + self.aimed[joint].apply(self.offsets[joint])
        return out


def fit_rig(positions: np.ndarray, joints: tuple[str, ...], parents: tuple[int, ...], rate_hz: float) -> Rig:
    """Rig of a clip.

    Parameters
    ----------
    positions : (F, P, 3) m, y up, without NaN
    rate_hz : frames per second

    Bone lengths are medians over the frames.
    """
    order = _outwards(parents)
    children = [[c for c in order if parents[c] == j] for j in range(len(parents))]
    bones = positions - positions[:, np.maximum(parents, 0)]
    lengths = np.median(np.linalg.norm(bones, axis=2), axis=0)
    directions = bones / np.maximum(np.linalg.norm(bones, axis=2, keepdims=True), 1e-9)
    rest = _rest_directions(directions, joints, children[order[0]])
    identity = Rotation.identity(len(positions))
    turned, aimed = [identity] * len(parents), [identity] * len(parents)
    for joint in order:
        above = turned[parents[joint]] if parents[joint] >= 0 else identity
        hanging = children[joint]
        if len(hanging) > 1:
            fit = np.einsum("fci,cj->fij", directions[:, hanging], rest[hanging])
            above = Rotation.from_matrix(project_to_so3(fit))
        for child in hanging:
            aimed[child] = above * _swing(rest[child], above.inv().apply(directions[:, child]), rate_hz)
        turned[joint] = aimed[hanging[0]] if len(hanging) == 1 else above
    return Rig(order, rest * lengths[:, None] * (np.array(parents) >= 0)[:, None], tuple(turned), tuple(aimed))


def _outwards(parents: tuple[int, ...]) -> tuple[int, ...]:
    order = [j for j, parent in enumerate(parents) if parent < 0]
    for joint in order:
        order.extend(j for j, parent in enumerate(parents) if parent == joint)
    return tuple(order)


def _rest_directions(directions: np.ndarray, joints: tuple[str, ...], below_root: list[int]) -> np.ndarray:
    rest = np.array([_REST.get(name, (0, 0, 0)) for name in joints], float)
    # A joint without an entry rests in its median direction relative to the root.
    known = [j for j in below_root if joints[j] in _REST]
    body = project_to_so3(np.einsum("fci,cj->fij", directions[:, known], rest[known]))
    usual = np.median(np.einsum("fji,fpj->fpi", body, directions), axis=0)
    rest = np.where(np.any(rest != 0, axis=1, keepdims=True), rest, usual)
    norm = np.linalg.norm(rest, axis=1, keepdims=True)
    return np.where(norm > 1e-6, rest / np.maximum(norm, 1e-9), (0.0, 1.0, 0.0))


def _swing(rest: np.ndarray, direction: np.ndarray, rate_hz: float) -> Rotation:
    """Smallest rotations (F,) from ``rest`` (3,) to ``direction`` (F, 3), made continuous over time.

    Where a bone points against its rest direction, the smallest rotation is ambiguous and jumps; there the rotation
    continues from the previous frame, and the added twist fades out.
    """
    swing = _shortest_arc(np.broadcast_to(rest, direction.shape), direction)
    if len(direction) < 2:
        return swing
    carried = _shortest_arc(direction[:-1], direction[1:]) * swing[:-1]
    quaternion = (swing[1:].inv() * carried).as_quat()
    jump = 2.0 * np.arctan2(quaternion[:, :3] @ rest, quaternion[:, 3])
    jump = (jump + np.pi) % (2.0 * np.pi) - np.pi
    keep = float(np.exp(-1.0 / (rate_hz * TWIST_FADE_S)))
    twist = lfilter([keep], [1.0, -keep], np.concatenate([[0.0], jump]))
    return swing * Rotation.from_rotvec(twist[:, None] * rest)


def _shortest_arc(a: np.ndarray, b: np.ndarray) -> Rotation:
    axis, cosine = np.cross(a, b), np.sum(a * b, axis=1)
    # Opposite directions: half a turn about any perpendicular axis.
    across = np.cross(a, np.where(np.abs(a[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    opposite = cosine < -1.0 + 1e-12
    quaternion = np.concatenate([np.where(opposite[:, None], across, axis), 1.0 + cosine[:, None]], axis=1)
    quaternion[opposite, 3] = 0.0
    return Rotation.from_quat(quaternion)
