"""Binary glTF 2.0: an animated skeleton with a simple visible body; metres, y up, the frames' own times.

Each joint is a node of the skin's hierarchy with animated rotation (as in :mod:`drocap_ros.export.rig`) and
translation: the positions equal those of the motion although its bone lengths vary a little.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drocap_ros.errors import InputError
from drocap_ros.export.body_mesh import COLOURS, body_mesh
from drocap_ros.export.clip import Clip, without_gaps, y_up
from drocap_ros.export.rig import Rig, fit_rig

_ARRAY_BUFFER = 34962
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"float32": 5126, "uint8": 5121}
#: A GLB stores its length in 32 bits.
_MAX_BYTES = 2**32 - 2**20


def write_glb(path: Path, clip: Clip) -> tuple[str, ...]:
    """Write a GLB file of a z-up clip; returns notes on changes.

    Raises
    ------
    InputError
        When a joint is never known, or the file would exceed 4 GiB.
    """
    clip = without_gaps(y_up(clip))
    if clip.positions.size * 14 > _MAX_BYTES:
        raise InputError(f"motion: expected less than 4 GiB of glTF, got {len(clip.positions)} frames; cut it")
    rig = fit_rig(clip.positions, clip.joints, clip.parents, clip.rate_hz)
    path.write_bytes(_container(*_document(clip, rig)))
    return clip.notes


class _Buffer:
    """The binary chunk and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, *, bounds: bool = False, target: int | None = None) -> int:
        """Append rows (N,) or (N, k) as float32 or uint8; returns the accessor's index."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        if target:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": _COMPONENTS[str(array.dtype)],
            "count": len(array),
            "type": _TYPES[1 if array.ndim == 1 else array.shape[1]],
        }
        if bounds:
            accessor["min"] = np.atleast_1d(array.min(axis=0)).tolist()
            accessor["max"] = np.atleast_1d(array.max(axis=0)).tolist()
        self.data += np.ascontiguousarray(array).tobytes()
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _document(clip: Clip, rig: Rig) -> tuple[dict[str, Any], bytes]:
    buffer = _Buffer()
    rest = _rest_positions(rig, clip.parents)
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(rest), 1, 1))
    inverse_bind[:, :3, 3] = -rest
    skin = buffer.add(np.ascontiguousarray(inverse_bind.transpose(0, 2, 1)).reshape(-1, 16))
    primitives = [_primitive(buffer, part, number) for number, part in enumerate(body_mesh(rest, clip))]
    animation = _animation(buffer, clip, rig)
    roots = [joint for joint, parent in enumerate(clip.parents) if parent < 0]
    body = len(clip.joints)
    document = {
        "asset": {"version": "2.0", "generator": "drocap_ros", "extras": _facts(clip)},
        "scene": 0,
        "scenes": [{"name": "motion", "nodes": [*roots, body]}],
        "nodes": [*_joint_nodes(clip, rest), {"name": "body", "mesh": 0, "skin": 0}],
        "meshes": [{"name": "body", "primitives": primitives}],
        "materials": [_material(name, colour) for name, colour in COLOURS.items()],
        "skins": [{"name": "skeleton", "joints": list(range(body)), "inverseBindMatrices": skin, "skeleton": roots[0]}],
        "animations": [animation],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    return document, bytes(buffer.data)


def _facts(clip: Clip) -> dict[str, Any]:
    return {"units": "m", "up_axis": "Y", "frame_rate_hz": round(clip.rate_hz, 6), "notes": list(clip.notes)}


def _rest_positions(rig: Rig, parents: tuple[int, ...]) -> np.ndarray:
    """(P, 3) joints in the rest pose, standing on the ground."""
    rest = np.zeros((len(parents), 3))
    for joint in rig.order:
        if parents[joint] >= 0:
            rest[joint] = rest[parents[joint]] + rig.offsets[joint]
    rest[:, 1] -= rest[:, 1].min()
    return rest


def _joint_nodes(clip: Clip, rest: np.ndarray) -> list[dict[str, Any]]:
    nodes: list[dict[str, Any]] = []
    for joint, (name, parent) in enumerate(zip(clip.joints, clip.parents, strict=True)):
        place = rest[joint] - rest[parent] if parent >= 0 else rest[joint]
        node: dict[str, Any] = {"name": name, "translation": np.round(place, 6).tolist()}
        children = [c for c, p in enumerate(clip.parents) if p == joint]
        nodes.append({**node, "children": children} if children else node)
    return nodes


def _primitive(buffer: _Buffer, part: Any, material: int) -> dict[str, Any]:
    attributes = {
        "POSITION": buffer.add(part.vertices, bounds=True, target=_ARRAY_BUFFER),
        "NORMAL": buffer.add(part.normals, target=_ARRAY_BUFFER),
        "JOINTS_0": buffer.add(part.joints, target=_ARRAY_BUFFER),
        "WEIGHTS_0": buffer.add(part.weights, target=_ARRAY_BUFFER),
    }
    return {"attributes": attributes, "material": material}


def _material(name: str, colour: tuple[float, float, float]) -> dict[str, Any]:
    surface = {"baseColorFactor": [*colour, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return {"name": name, "pbrMetallicRoughness": surface}


def _animation(buffer: _Buffer, clip: Clip, rig: Rig) -> dict[str, Any]:
    times = buffer.add(clip.times_s.astype(np.float32), bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    identity = Rotation.identity(len(clip.positions))
    for joint, parent in enumerate(clip.parents):
        above = rig.turned[parent] if parent >= 0 else identity
        origin = clip.positions[:, parent] if parent >= 0 else 0.0
        tracks = {
            "translation": above.inv().apply(clip.positions[:, joint] - origin),
            "rotation": _continuous((above.inv() * rig.turned[joint]).as_quat()),
        }
        for kind, values in tracks.items():
            channels.append({"sampler": len(samplers), "target": {"node": joint, "path": kind}})
            output = buffer.add(values.astype(np.float32))
            samplers.append({"input": times, "interpolation": "LINEAR", "output": output})
    return {"name": "motion", "samplers": samplers, "channels": channels}


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """The same rotations (F, 4), each with the sign nearer to the previous frame."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _container(document: dict[str, Any], data: bytes) -> bytes:
    """GLB of a JSON chunk and a binary chunk (glTF 2.0 specification, section 4.4)."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(data)
    return b"".join(
        [b"glTF", struct.pack("<II", 2, length), struct.pack("<I", len(text)), b"JSON", text,
         struct.pack("<I", len(data)), b"BIN\0", data]
    )  # fmt: skip
