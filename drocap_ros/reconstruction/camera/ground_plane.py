"""The ground as the plane of most of the points below a camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Planes through three points that are tried, and distance of a point on one over the camera's height above it.
_PLANES = 1000
_ON_PLANE = 0.03
#: Points on the plane, at least, and share of all.
LEAST_ON_PLANE = 20
LEAST_SHARE = 0.15


class GroundPlane(NamedTuple):
    """Points x with ``up @ x == level``; up (3,) of length 1, on the camera's side."""

    up: np.ndarray
    level: float


def largest_plane(places: np.ndarray, position: np.ndarray, up: np.ndarray, within_deg: float) -> GroundPlane | None:
    """The plane below a path (K, 3) on which most of the points (N, 3) lie; None = there is none.

    up : (3,) about across it, to ``within_deg``
    """
    if len(places) < LEAST_ON_PLANE:
        return None
    rng = np.random.default_rng(0)
    corners = places[rng.integers(len(places), size=(_PLANES, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal *= np.sign(normal @ up)[:, None]
    level = np.einsum("ni,ni->n", normal, corners[:, 0])
    height = np.median(position @ normal.T, axis=0) - level
    usual = (normal @ up > np.cos(np.deg2rad(within_deg))) & (height > 0.0)
    if not usual.any():
        return None
    normal, level, height = normal[usual], level[usual], height[usual]
    on = (np.abs(places @ normal.T - level) < _ON_PLANE * height).sum(axis=0)
    best = int(on.argmax())
    if on[best] < max(LEAST_ON_PLANE, LEAST_SHARE * len(places)):
        return None
    return GroundPlane(normal[best], float(level[best]))
