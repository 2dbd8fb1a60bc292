"""Animation skeletons with constant bones, y up.  BVH: centimetres, degrees; binary glTF 2.0: metres.

In glTF each joint of :mod:`drocap_ros.export.rig` is a node of the skin's hierarchy with animated rotation; the root's
translation is animated too.  The skin needs a mesh: each bone is an octahedron that follows its joint.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.export.measured import continuous_euler
from drocap_ros.export.rig import Rig, rig_of
from drocap_ros.export.rigid_body import BODY
from drocap_ros.export.take import Take, at_constant_rate, y_up

_FORMAT = "%.5f"


def write_bvh(path: Path, take: Take, *, names: str = "h36m", rest: str = "t") -> tuple[str, ...]:
    """Write a BVH file; returns notes on changes.

    take : z-up; it is resampled to a constant rate, and its gaps are interpolated
    names, rest : as of :func:`~drocap_ros.export.rig.rig_of`
    """
    take = y_up(at_constant_rate(take))
    rig, notes = rig_of(take, names=names, rest=rest)
    lines: list[str] = ["HIERARCHY"]
    # The root rests where its channels put it, so that a viewer without channels shows a standing person.
    columns = [100.0 * rig.root]
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
    return " ".join(_FORMAT % v for v in 100.0 * metres + 0.0)


#: An object of glTF's JSON.
Json = dict[str, object]
#: Codes of glTF 2.0: uses of a buffer, shapes and types of its elements.
_ARRAY_BUFFER = 34962
_ELEMENT_BUFFER = 34963  # of indices
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"float32": 5126, "uint8": 5121, "uint16": 5123}
#: Half width of a drawn bone, and its distance from the joint, as shares of the bone's length; a matter of taste.
_GIRTH = 0.1
#: A GLB stores its length in 32 bits.
_MAX_BYTES = 2**32 - 2**20


def write_glb(path: Path, take: Take, *, names: str = "h36m", rest: str = "t") -> tuple[str, ...]:
    """Write a GLB file of a z-up take; returns notes on changes.

    names, rest : as of :func:`~drocap_ros.export.rig.rig_of`
    """
    if len(take.positions) * len(BODY) * 16 > _MAX_BYTES:
        raise InputError(f"motion: expected less than 4 GiB of glTF, got {len(take.positions)} frames; cut it")
    rig, notes = rig_of(y_up(take), names=names, rest=rest)
    facts = {"units": "m", "up_axis": "Y", "frame_rate_hz": round(take.rate_hz, 6), "notes": list(notes)}
    path.write_bytes(_container(*_document(rig, take.times_s, facts)))
    return notes


class _Buffer:
    """The binary chunk and the accessors into it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[Json] = []
        self.accessors: list[Json] = []

    def add(self, array: np.ndarray, *, bounds: bool = False, target: int | None = None) -> int:
        """Append rows (N,) or (N, k) as float32 or uint8; returns the accessor's index."""
        view: Json = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        if target:
            view["target"] = target
        accessor: Json = {
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


def _document(rig: Rig, times_s: np.ndarray, facts: Json) -> tuple[Json, bytes]:
    buffer = _Buffer()
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(rig.rest), 1, 1))
    inverse_bind[:, :3, 3] = -rig.rest
    skin = buffer.add(np.ascontiguousarray(inverse_bind.transpose(0, 2, 1)).reshape(-1, 16))
    bones = _bones(buffer, rig)
    animation = _animation(buffer, rig, times_s)
    body = len(rig.names)
    document = {
        "asset": {"version": "2.0", "generator": "drocap_ros", "extras": facts},
        "scene": 0,
        "scenes": [{"name": "motion", "nodes": [0, body]}],
        "nodes": [*_joint_nodes(rig), {"name": "bones", "mesh": 0, "skin": 0}],
        "meshes": [{"name": "bones", "primitives": [bones]}],
        "skins": [{"name": "skeleton", "joints": list(range(body)), "inverseBindMatrices": skin, "skeleton": 0}],
        "animations": [animation],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    return document, bytes(buffer.data)


def _joint_nodes(rig: Rig) -> list[Json]:
    nodes: list[Json] = []
    for joint, (name, parent) in enumerate(zip(rig.names, rig.parents, strict=True)):
        place = rig.rest[joint] - (rig.rest[parent] if parent >= 0 else 0.0)
        node: Json = {"name": name, "translation": np.round(place, 7).tolist()}
        children = [c for c, p in enumerate(rig.parents) if p == joint]
        nodes.append({**node, "children": children} if children else node)
    return nodes


def octahedra(rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From each joint to its children or its bone's end: corners (N, 3) m at rest, faces (K, 3), joints (N,)."""
    tips = [(parent, rig.rest[child]) for child, parent in enumerate(rig.parents) if parent >= 0]
    tips += [(joint, rig.rest[joint] + end) for joint, end in rig.ends.items()]
    owner = np.array([joint for joint, _ in tips])
    along = np.array([tip for _, tip in tips]) - rig.rest[owner]
    _, _, axes = np.linalg.svd(along[:, None])
    aside = _GIRTH * np.linalg.norm(along, axis=1)[:, None, None] * axes[:, 1:]
    # Right-handed with the bone, so that the corners below turn counter-clockwise from outside.
    aside[:, 1] *= np.sign(np.linalg.det(np.stack([along, aside[:, 0], aside[:, 1]], axis=1)))[:, None]
    ring = _GIRTH * along[:, None] + np.stack([aside[:, 0], aside[:, 1], -aside[:, 0], -aside[:, 1]], axis=1)
    corners = np.concatenate([np.zeros_like(ring[:, :1]), ring, along[:, None]], axis=1) + rig.rest[owner][:, None]
    faces = np.array([face for i in range(4) for face in ((0, 1 + (i + 1) % 4, 1 + i), (5, 1 + i, 1 + (i + 1) % 4))])
    triangles = 6 * np.arange(len(tips))[:, None, None] + faces
    return corners.reshape(-1, 3), triangles.reshape(-1, 3), np.repeat(owner, 6)


def _bones(buffer: _Buffer, rig: Rig) -> Json:
    """The mesh; without normals viewers shade it flat."""
    corners, triangles, owner = octahedra(rig)
    joints = np.zeros((len(owner), 4), np.uint8)
    joints[:, 0] = owner
    attributes = {
        "POSITION": buffer.add(corners.astype(np.float32), bounds=True, target=_ARRAY_BUFFER),
        "JOINTS_0": buffer.add(joints, target=_ARRAY_BUFFER),
        "WEIGHTS_0": buffer.add(np.tile(np.eye(4, dtype=np.float32)[0], (len(joints), 1)), target=_ARRAY_BUFFER),
    }
    indices = triangles.astype(np.uint16).reshape(-1)
    return {"attributes": attributes, "indices": buffer.add(indices, target=_ELEMENT_BUFFER)}


def _animation(buffer: _Buffer, rig: Rig, times_s: np.ndarray) -> Json:
    times = buffer.add(times_s.astype(np.float32), bounds=True)
    tracks = [(0, "translation", rig.root)]
    tracks += [(joint, "rotation", continuous(rig.local(joint).as_quat())) for joint in range(len(rig.names))]
    samplers: list[Json] = []
    channels: list[Json] = []
    for node, kind, values in tracks:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": kind}})
        output = buffer.add(values.astype(np.float32))
        samplers.append({"input": times, "interpolation": "LINEAR", "output": output})
    return {"name": "motion", "samplers": samplers, "channels": channels}


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """The same rotations (F, 4), each with the sign nearer to the previous frame."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _container(document: Json, data: bytes) -> bytes:
    """GLB of a JSON chunk and a binary chunk (glTF 2.0 specification, section 4.4)."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + len(data)
    chunks = [struct.pack("<I", len(text)), b"JSON", text, struct.pack("<I", len(data)), b"BIN\0", data]
    return b"".join([b"glTF", struct.pack("<II", 2, length), *chunks])
