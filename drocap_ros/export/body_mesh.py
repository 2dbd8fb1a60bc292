"""A visible body of spindles and knobs for an exported skeleton."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.export.clip import Clip
from drocap_ros.skeleton import side_of

#: Linear RGB of the body's sides; the order is that of the parts and of the materials.
COLOURS = {"right": (0.53, 0.04, 0.03), "left": (0.02, 0.16, 0.37), "middle": (0.18, 0.18, 0.2)}

_KNOB_M = 0.025
#: Half width of a bone as a share of its length, and at most, m.
_GIRTH, _MAX_GIRTH_M = 0.12, 0.045
#: Share of the bone's length at which it is widest.
_WAIST = 0.15
#: Eight faces of an octahedron with corners foot, four about the waist, tip; counter-clockwise from outside.
_FACES = np.array([(0, 1 + (i + 1) % 4, 1 + i) for i in range(4)] + [(5, 1 + i, 1 + (i + 1) % 4) for i in range(4)])


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one colour, three vertices each: (N, 3) vertices, normals; (N, 4) joints and weights of the skin."""

    vertices: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    weights: np.ndarray


def body_mesh(rest: np.ndarray, clip: Clip) -> list[MeshPart]:
    """One part per colour of the body in its rest pose ``rest`` (P, 3).

    Foot and waist of a bone follow its first joint, its tip follows the second one.
    """
    corners: dict[str, list[np.ndarray]] = {side: [] for side in COLOURS}
    owners: dict[str, list[np.ndarray]] = {side: [] for side in COLOURS}
    for joint, parent in enumerate(clip.parents):
        side = side_of(clip.joints[joint], clip.joints)
        corners[side].append(rest[joint] + _KNOB_M * _octahedron(np.array([0.0, 1.0, 0.0])))
        owners[side].append(np.full(6, joint))
        if parent >= 0:
            corners[side].append(_spindle(rest[parent], rest[joint]))
            owners[side].append(np.array([parent] * 5 + [joint]))
    return [_part(np.array(corners[side]), np.array(owners[side])) for side in COLOURS if corners[side]]


def _octahedron(along: np.ndarray) -> np.ndarray:
    """(6, 3) corners on the unit sphere: against ``along``, four around it, along it."""
    first = np.cross(along, [0.0, 0.0, 1.0] if abs(along[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(along, first)
    return np.array([-along, first, second, -first, -second, along])


def _spindle(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    length = max(float(np.linalg.norm(end - start)), 1e-6)
    along = (end - start) / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])
    around = _octahedron(along)[1:5] * min(_GIRTH * length, _MAX_GIRTH_M)
    return np.array([start, *(start + _WAIST * (end - start) + around), end])


def _part(corners: np.ndarray, owners: np.ndarray) -> MeshPart:
    triangles = corners[:, _FACES]
    normals = np.cross(triangles[:, :, 1] - triangles[:, :, 0], triangles[:, :, 2] - triangles[:, :, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    vertices = triangles.reshape(-1, 3)
    joints = np.zeros((len(vertices), 4), np.uint8)
    joints[:, 0] = owners[:, _FACES].reshape(-1)
    weights = np.zeros((len(vertices), 4), np.float32)
    weights[:, 0] = 1.0
    spread = np.repeat(normals.reshape(-1, 3), 3, axis=0)
    return MeshPart(vertices.astype(np.float32), spread.astype(np.float32), joints, weights)
