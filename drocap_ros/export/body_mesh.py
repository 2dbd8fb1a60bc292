"""A plain clothed body around an exported skeleton: tubes of elliptic rings, made here, not the shape of the person."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from drocap_ros.export.rig import Rig

#: Linear RGB of the materials.
COLOURS = {
    "skin": (0.53, 0.29, 0.19), "shirt": (0.03, 0.16, 0.32),
    "trousers": (0.05, 0.05, 0.07), "shoes": (0.02, 0.02, 0.02),
}  # fmt: skip
_RINGS, _CORNERS = 28, 18
#: Legs, hip to ankle, as a share of the stature (Winter 2009, table 4.1), which scales the girths.
_LEGS = 0.491

#: A station of a tube: centre (3,) m, half widths aside and forwards in shares of the stature, joint, material.
Station = tuple[np.ndarray, float, float, str, str]


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one material; N vertices, T triangles.

    vertices, normals : (N, 3) in the rest pose, m
    joints, weights : (N, 4) of the skin; four joints' indices and their weights, which sum to 1
    triangles : (T, 3) vertex indices, counter-clockwise from outside
    """

    material: str
    vertices: np.ndarray
    normals: np.ndarray
    joints: np.ndarray
    weights: np.ndarray
    triangles: np.ndarray


def body_mesh(rig: Rig) -> list[MeshPart]:
    """One part per material of the body in the rig's rest pose."""
    at = {joint: rig.rest[i] for i, joint in enumerate(rig.joints)}
    tip = {rig.joints[i]: rig.rest[i] + end for i, end in rig.ends.items()}
    stature = (at["lhip"][1] - at["lankle"][1]) / _LEGS
    tubes = [(_torso(at), (1.0, 0.0, 0.0)), (_head(at, tip, stature), (1.0, 0.0, 0.0))]
    for side in "lr":
        tubes += [
            (_arm(at, tip, side), (0.0, 1.0, 0.0)),
            (_leg(at, side, stature), (1.0, 0.0, 0.0)),
            (_foot(at, tip, side, stature), (1.0, 0.0, 0.0)),
        ]
    grids = [_tube(stations, np.array(aside), stature, rig.joints) for stations, aside in tubes]
    return [_part(name, [grid for grids_of in grids for grid in grids_of if grid.material == name]) for name in COLOURS]


def _torso(at: dict[str, np.ndarray]) -> list[Station]:
    pelvis, thorax = at["pelvis"], at["thorax"]
    trunk = thorax - pelvis

    def level(share: float, aside: float, forwards: float, joint: str, cloth: str = "shirt") -> Station:
        return (pelvis + share * trunk, aside, forwards, joint, cloth)

    return [
        level(-0.22, 0.0, 0.0, "pelvis", "trousers"),
        level(-0.14, 0.07, 0.055, "pelvis", "trousers"),
        level(0.0, 0.098, 0.068, "pelvis", "trousers"),
        level(0.14, 0.092, 0.065, "pelvis", "trousers"),
        level(0.25, 0.083, 0.06, "spine"),
        level(0.45, 0.083, 0.06, "chest"),
        level(0.72, 0.098, 0.068, "upperchest"),
        level(0.9, 0.1, 0.062, "upperchest"),
        level(1.02, 0.075, 0.045, "upperchest"),
        level(1.09, 0.04, 0.034, "thorax"),
        level(1.14, 0.0, 0.0, "thorax"),
    ]  # fmt: skip


def _head(at: dict[str, np.ndarray], tip: dict[str, np.ndarray], stature: float) -> list[Station]:
    base, skull = at["thorax"], at["neck"]
    crown = tip["head"] if "head" in tip else tip["neck"]
    chin = skull + 0.1 * (crown - skull)
    forwards = np.array([0.0, 0.0, 0.012 * stature])
    return [
        (base, 0.0, 0.0, "upperchest", "skin"),
        (base + 0.25 * (skull - base), 0.034, 0.034, "thorax", "skin"),
        (skull, 0.031, 0.034, "thorax", "skin"),
        (chin + forwards, 0.036, 0.046, "neck", "skin"),
        (skull + 0.45 * (crown - skull) + forwards, 0.044, 0.056, "neck", "skin"),
        (skull + 0.8 * (crown - skull) + forwards, 0.04, 0.05, "neck", "skin"),
        (crown + forwards, 0, 0, "neck", "skin"),
    ]  # fmt: skip


def _arm(at: dict[str, np.ndarray], tip: dict[str, np.ndarray], side: str) -> list[Station]:
    collar, shoulder, elbow, wrist = (at[side + name] for name in ("collar", "shoulder", "elbow", "wrist"))
    upper, fore, hand = elbow - shoulder, wrist - elbow, tip[side + "wrist"] - wrist
    drop = np.array([0.0, -0.02 * np.linalg.norm(upper), 0.0])
    return [
        (collar + drop, 0.0, 0.0, "upperchest", "shirt"),
        (0.5 * (collar + shoulder) + drop, 0.034, 0.04, "upperchest", "shirt"),
        (shoulder, 0.035, 0.037, side + "collar", "shirt"),
        (shoulder + 0.25 * upper, 0.031, 0.033, side + "shoulder", "shirt"),
        (shoulder + 0.55 * upper, 0.028, 0.03, side + "shoulder", "skin"),
        (shoulder + 0.85 * upper, 0.024, 0.025, side + "shoulder", "skin"),
        (elbow + 0.15 * fore, 0.0245, 0.026, side + "elbow", "skin"),
        (elbow + 0.4 * fore, 0.023, 0.0235, side + "elbow", "skin"),
        (elbow + 0.95 * fore, 0.014, 0.017, side + "elbow", "skin"),
        (wrist + 0.15 * hand, 0.0135, 0.02, side + "wrist", "skin"),
        (wrist + 0.5 * hand, 0.012, 0.025, side + "wrist", "skin"),
        (wrist + 0.8 * hand, 0.009, 0.02, side + "wrist", "skin"),
        (tip[side + "wrist"], 0.0, 0.0, side + "wrist", "skin"),
    ]  # fmt: skip


def _leg(at: dict[str, np.ndarray], side: str, stature: float) -> list[Station]:
    hip, knee, ankle = (at[side + name] for name in ("hip", "knee", "ankle"))
    thigh, shank = knee - hip, ankle - knee
    back = np.array([0.0, 0.0, -0.01 * stature])
    return [
        (hip - 0.22 * thigh, 0.0, 0.0, "pelvis", "trousers"),
        (hip - 0.08 * thigh, 0.044, 0.055, "pelvis", "trousers"),
        (hip + 0.12 * thigh, 0.05, 0.056, side + "hip", "trousers"),
        (hip + 0.5 * thigh, 0.043, 0.048, side + "hip", "trousers"),
        (hip + 0.88 * thigh, 0.034, 0.037, side + "hip", "trousers"),
        (knee + 0.1 * shank, 0.032, 0.034, side + "knee", "trousers"),
        (knee + 0.35 * shank + back, 0.033, 0.036, side + "knee", "trousers"),
        (knee + 0.8 * shank, 0.025, 0.027, side + "knee", "trousers"),
        (ankle, 0.024, 0.027, side + "knee", "trousers"),
        (ankle + 0.06 * shank, 0.0, 0.0, side + "ankle", "trousers"),
    ]  # fmt: skip


def _foot(at: dict[str, np.ndarray], tip: dict[str, np.ndarray], side: str, stature: float) -> list[Station]:
    ankle, last = at[side + "ankle"], side + "ankle"
    toe = at.get(side + "toe", tip.get(last))
    ball = side + "toe" if side + "toe" in at else last
    forwards = (toe - ankle) * (1, 0, 1)
    heel = ankle * (1, 0, 1) - 0.3 * forwards

    def ring(share: float, aside: float, height: float, joint: str) -> Station:
        up = np.array([0.0, height * stature, 0.0])
        return (heel + share * 1.55 * forwards + up, aside, height, joint, "shoes")

    return [
        ring(0.0, 0.0, 0.014, last), ring(0.04, 0.017, 0.02, last), ring(0.25, 0.021, 0.026, last),
        ring(0.55, 0.025, 0.018, last), ring(0.75, 0.028, 0.014, ball), ring(0.92, 0.022, 0.011, ball),
        ring(1.0, 0.0, 0.009, ball),
    ]  # fmt: skip


class Grid(NamedTuple):
    """Rings of one material: vertices and normals (R, C, 3), weights of the J joints (R, C, J)."""

    material: str
    vertices: np.ndarray
    normals: np.ndarray
    weights: np.ndarray


def _tube(stations: list[Station], aside: np.ndarray, stature: float, joints: tuple[str, ...]) -> list[Grid]:
    """Smooth tube through the stations, one grid per run of rings of one material."""
    centres = np.array([s[0] for s in stations])
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(centres, axis=0), axis=1), 1e-6))])
    # Rings crowd at the ends; squared widths are interpolated, so that the ends are round.
    t = knots[-1] * 0.5 * (1.0 - np.cos(np.linspace(0.0, np.pi, _RINGS)))
    middle = PchipInterpolator(knots, centres)(t)
    squares = PchipInterpolator(knots, np.array([s[1:3] for s in stations]) ** 2)(t)
    widths = stature * np.sqrt(np.maximum(squares, 0.0))
    owner = np.zeros((len(stations), len(joints)))
    owner[np.arange(len(stations)), [joints.index(s[3]) for s in stations]] = 1.0
    weights = np.stack([np.interp(t, knots, column) for column in owner.T], axis=1)
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    first = aside - along * (along @ aside)[:, None]
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(along, first)
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    ring = np.cos(angle)[:, None, None] * first * widths[:, :1] + np.sin(angle)[:, None, None] * second * widths[:, 1:]
    vertices = middle[:, None] + np.swapaxes(ring, 0, 1)
    du, dv = np.gradient(vertices, axis=0), np.gradient(vertices, axis=1)
    dv[:, [0, -1]] = 0.5 * (dv[:, :1] + dv[:, -1:])
    normals = np.cross(dv, du)
    size = np.linalg.norm(normals, axis=2, keepdims=True)
    # The tips are points: their normals point along the tube.
    poles = along[:, None] * np.where(np.arange(_RINGS) < _RINGS / 2, -1.0, 1.0)[:, None, None]
    normals = np.where(size > 1e-12, normals / np.maximum(size, 1e-12), poles)
    spread = np.repeat(weights[:, None], len(angle), axis=1)
    materials = [stations[max(int(np.searchsorted(knots, x, side="right")) - 1, 0)][4] for x in t[:-1]]
    breaks = [0, *(i for i in range(1, len(materials)) if materials[i] != materials[i - 1]), len(materials)]
    return [Grid(materials[a], vertices[a : b + 1], normals[a : b + 1], spread[a : b + 1]) for a, b in pairwise(breaks)]


def _part(material: str, grids: list[Grid]) -> MeshPart:
    triangles, first = [], 0
    for grid in grids:
        rings, corners = grid.vertices.shape[:2]
        index = first + np.arange(rings * corners).reshape(rings, corners)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        triangles.append(np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3))
        first += rings * corners
    surfaces = [grid.vertices for grid in grids], [grid.normals for grid in grids]
    vertices, normals = (np.concatenate([g.reshape(-1, 3) for g in values]) for values in surfaces)
    weights = np.concatenate([grid.weights.reshape(-1, grid.weights.shape[2]) for grid in grids])
    order = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    strongest = np.take_along_axis(weights, order, axis=1)
    strongest /= strongest.sum(axis=1, keepdims=True)
    return MeshPart(
        material, vertices.astype(np.float32), normals.astype(np.float32),
        np.where(strongest > 0, order, 0).astype(np.uint8), strongest.astype(np.float32),
        np.concatenate(triangles).astype(np.uint16),
    )  # fmt: skip
