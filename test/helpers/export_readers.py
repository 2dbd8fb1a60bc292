"""Readers of exported files by independent libraries: positions (F, P, 3) m, z up, names and rate."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np


class ReadBack(NamedTuple):
    joints: tuple[str, ...]
    positions: np.ndarray
    rate_hz: float
    times_s: np.ndarray


def z_up(y_up: np.ndarray) -> np.ndarray:
    x, y, z = np.moveaxis(y_up, -1, 0)
    return np.stack([x, -z, y], axis=-1)


def read_bvh(path: Path) -> ReadBack:
    """Forward kinematics by bvhio."""
    import bvhio

    root = bvhio.readAsHierarchy(str(path))
    document = bvhio.readAsBvh(str(path))
    nodes = [node for node, _, _ in root.layout()]
    positions = []
    for frame in range(document.FrameCount):
        root.loadPose(frame)
        positions.append([[*node.PositionWorld] for node in nodes])
    times = np.arange(document.FrameCount) * document.FrameTime
    return ReadBack(
        tuple(node.Name for node in nodes), z_up(np.array(positions)) / 100.0, 1.0 / document.FrameTime, times
    )


def read_c3d(path: Path) -> ReadBack:
    """By ezc3d, which is not the writing library; missing points are NaN."""
    import ezc3d

    content = ezc3d.c3d(str(path))
    point = content["parameters"]["POINT"]
    assert point["UNITS"]["value"] == ["mm"]
    assert [point[name]["value"] for name in ("X_SCREEN", "Y_SCREEN")] == [["+X"], ["+Z"]]
    positions = content["data"]["points"][:3].transpose(2, 1, 0) / 1000.0
    residuals = content["data"]["meta_points"]["residuals"][0].T
    positions[residuals < 0] = np.nan
    rate = float(point["RATE"]["value"][0])
    return ReadBack(tuple(point["LABELS"]["value"]), positions, rate, np.arange(len(positions)) / rate)


def read_trc(path: Path) -> ReadBack:
    """By trc-data-reader."""
    import trc

    data = trc.TRCData()
    data.load(str(path))
    assert data["Units"] == "mm"
    assert data["NumFrames"] == len(data["Time"])
    positions = np.array([data[marker] for marker in data["Markers"]]).transpose(1, 0, 2)
    return ReadBack(tuple(data["Markers"]), z_up(positions) / 1000.0, data["DataRate"], np.array(data["Time"]))


def read_csv(path: Path) -> ReadBack:
    """By Python's csv."""
    with path.open(newline="") as file:
        head, *rows = list(csv.reader(file))
    assert head[:2] == ["time_s", "frame"]
    assert all(name.endswith(f"_{axis}_m") for name, axis in zip(head[2:], "xyz" * len(head), strict=False))
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    names = tuple(name.removesuffix("_x_m") for name in head[2::3])
    times = values[:, 0]
    return ReadBack(names, values[:, 2:].reshape(len(rows), -1, 3), 1.0 / np.median(np.diff(times)), times)


def read_glb(path: Path) -> ReadBack:
    """Parsed by pygltflib; the nodes' transformations composed by scipy."""
    import pygltflib
    from scipy.spatial.transform import Rotation

    document = pygltflib.GLTF2().load(str(path))
    animation = document.animations[0]
    skin = document.skins[0]
    above = {child: number for number, node in enumerate(document.nodes) for child in node.children or []}
    tracks = {(c.target.node, c.target.path): animation.samplers[c.sampler] for c in animation.channels}
    times = gltf_array(document, animation.samplers[0].input)
    placed: dict[int, tuple[np.ndarray, Rotation]] = {}
    for joint in skin.joints:
        node = document.nodes[joint]
        moving = (joint, "translation") in tracks
        position = gltf_array(document, tracks[joint, "translation"].output) if moving else np.array(node.translation)
        rotation = Rotation.from_quat(gltf_array(document, tracks[joint, "rotation"].output))
        if joint in above:
            origin, turned = placed[above[joint]]
            position, rotation = origin + turned.apply(position), turned * rotation
        placed[joint] = (position, rotation)
    positions = np.stack([placed[joint][0] for joint in skin.joints], axis=1)
    names = tuple(document.nodes[joint].name for joint in skin.joints)
    return ReadBack(names, z_up(positions), document.asset.extras["frame_rate_hz"], times[:, 0])


def gltf_array(document, number: int) -> np.ndarray:
    """Rows of an accessor."""
    accessor = document.accessors[number]
    view = document.bufferViews[accessor.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
    kind = {5126: np.float32, 5121: np.uint8, 5123: np.uint16}[accessor.componentType]
    blob = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(blob, kind).reshape(accessor.count, width).astype(float)


def read_usd(path: Path) -> ReadBack:
    """Joints as UsdSkel itself computes them."""
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    cache, rate = UsdSkel.Cache(), stage.GetTimeCodesPerSecond()
    root = UsdSkel.Root(stage.GetPrimAtPath("/Motion/Person"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/Motion/Person/Skeleton")))
    codes = query.GetAnimQuery().GetJointTransformTimeSamples()
    positions = [[m.ExtractTranslation() for m in query.ComputeJointSkelTransforms(code)] for code in codes]
    names = tuple(str(path).rsplit("/", 1)[-1] for path in query.GetJointOrder())
    return ReadBack(names, z_up(np.array(positions)), rate, np.array(codes) / rate)


READERS = {"bvh": read_bvh, "c3d": read_c3d, "trc": read_trc, "csv": read_csv, "glb": read_glb, "usd": read_usd}
