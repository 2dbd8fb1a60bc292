"""Clipped quadric surfaces (ellipsoids, cones) in a camera's view: exact outline and depth per pixel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Surfaces nearer to the camera are omitted, m.
_NEAR_M = 0.15


class Quadrics(NamedTuple):
    """N surfaces x'Ax + 2b'x + c = 0 in one frame, cut by two planes across an axis.

    a (N, 3, 3), b (N, 3), c (N,); axis (N, 3) unit, low, high (N,) m: the part with low <= axis'x <= high;
    ends (N, 2, 3) m and reach (N,) m: two spheres whose hull holds the surface.
    """

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    axis: np.ndarray
    low: np.ndarray
    high: np.ndarray
    ends: np.ndarray
    reach: np.ndarray


class Layer(NamedTuple):
    """Visible surfaces: origin x, y px of the layer; surface index (h, w) int16, -1 = none; light (h, w)."""

    x: int
    y: int
    surface: np.ndarray
    light: np.ndarray


def cones(start: np.ndarray, end: np.ndarray, start_m: np.ndarray, end_m: np.ndarray) -> Quadrics:
    """Sides of cut cones from start to end (N, 3) m with radii (N,) m at both."""
    along = end - start
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-6)
    axis = along / length[:, None]
    slope = (end_m - start_m) / length
    a = np.eye(3) - (1 + slope**2)[:, None, None] * axis[:, :, None] * axis[:, None, :]
    local = -(start_m * slope)[:, None] * axis
    a_start = np.einsum("nij,nj->ni", a, start)
    b = local - a_start
    c = np.sum(start * a_start, axis=1) - 2 * np.sum(local * start, axis=1) - start_m**2
    low = np.sum(axis * start, axis=1)
    ends = np.stack([start, end], axis=1)
    return Quadrics(a, b, c, axis, low, low + length, ends, np.maximum(start_m, end_m))


def ellipsoids(centre: np.ndarray, axes: np.ndarray, half_m: np.ndarray) -> Quadrics:
    """Ellipsoids about centre (N, 3) m with unit axes (N, 3 axes, 3) and half lengths (N, 3) m."""
    # Scaled by the square of the least half length: all surfaces then have coefficients of one magnitude.
    share = half_m.min(axis=1, keepdims=True) / half_m
    a = np.einsum("nki,nk,nkj->nij", axes, share**2, axes)
    b = -np.einsum("nij,nj->ni", a, centre)
    c = -np.sum(b * centre, axis=1) - half_m.min(axis=1) ** 2
    unlimited = np.full(len(centre), 1e9)
    ends = np.stack([centre, centre], axis=1)
    return Quadrics(a, b, c, axes[:, 0], -unlimited, unlimited, ends, half_m.max(axis=1))


def joined(parts: list[Quadrics]) -> Quadrics:
    """One set of the surfaces of several."""
    return Quadrics(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def rasterize(quadrics: Quadrics, matrix: np.ndarray, width: int, height: int, light: np.ndarray) -> Layer | None:
    """Rasterize the nearest surface at each pixel.

    Parameters
    ----------
    quadrics : in the camera's frame (x right, y down, z forward)
    matrix : (3, 3) px without skew, pixel centres at whole numbers
    width, height : px of the image
    light : (3,) unit, towards the light, in the camera's frame

    Returns
    -------
    The part of the image with the surfaces; its light is the cosine between normal and light (-1 to 1).
    None without a surface in view.
    """
    focal, middle = np.diag(matrix)[:2], matrix[:2, 2]
    boxes, visible = _boxes(quadrics, focal, middle, width, height)
    if not visible.any():
        return None
    x0, y0 = boxes[visible, :2].min(axis=0)
    x1, y1 = boxes[visible, 2:].max(axis=0)
    shape = (y1 - y0, x1 - x0)
    depth = np.full(shape, np.inf, np.float32)
    layer = Layer(int(x0), int(y0), np.full(shape, -1, np.int16), np.zeros(shape, np.float32))
    flat = (depth.ravel(), layer.surface.ravel(), layer.light.ravel())
    for i in np.flatnonzero(visible):
        _draw(quadrics, int(i), boxes[i], (focal, middle), light, (int(x0), int(y0), int(shape[1])), flat)
    return layer


def _boxes(
    q: Quadrics, focal: np.ndarray, middle: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4) px x0 y0 x1 y1 (ends excluded) within the image, and (N,) bool whether it is in view."""
    depth = q.ends[..., 2]
    safe = np.maximum(depth - q.reach[:, None], _NEAR_M)
    centre = q.ends[..., :2] / np.maximum(depth, _NEAR_M)[..., None] * focal + middle
    # Towards the edge of the image a sphere's outline grows by the secant of its angle.
    secant = np.sqrt(1 + np.sum(((centre - middle) / focal) ** 2, axis=-1))
    half = (q.reach[:, None] / safe * secant)[..., None] * focal + 1
    low = np.floor((centre - half).min(axis=1))
    high = np.ceil((centre + half).max(axis=1)) + 1
    size = np.array([width, height])
    low, high = np.clip(low, 0, size).astype(int), np.clip(high, 0, size).astype(int)
    visible = (high > low).all(axis=1) & (depth.min(axis=1) - q.reach > _NEAR_M)
    return np.concatenate([low, high], axis=1), visible


def _draw(
    q: Quadrics,
    i: int,
    box: np.ndarray,
    view: tuple[np.ndarray, np.ndarray],
    light: np.ndarray,
    place: tuple[int, int, int],
    flat: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Draw one surface into the flattened arrays of depth, surface and light."""
    a, b, c, axis = q.a[i], q.b[i], q.c[i], q.axis[i]
    (focal, middle), (left, top, stride) = view, place
    # Rays are base + x ex + y ey with x, y from the middle of the box: with coefficients in double precision,
    # single precision is enough for the pixels.
    base = np.append((0.5 * (box[:2] + box[2:]) - middle) / focal, 1.0)
    x = ((np.arange(box[0], box[2]) - 0.5 * (box[0] + box[2])) / focal[0]).astype(np.float32)
    y = ((np.arange(box[1], box[3]) - 0.5 * (box[1] + box[3])) / focal[1]).astype(np.float32)
    form = np.outer(b, b) - c * a
    fb = form @ base
    across = (form[0, 0] * x + 2 * fb[0]) * x + (base @ fb)
    down = (form[1, 1] * y + 2 * fb[1]) * y
    inside = (2 * form[0, 1] * y)[:, None].astype(np.float32) * x
    inside += across.astype(np.float32)
    inside += down[:, None].astype(np.float32)
    hit = np.flatnonzero(inside > 0)
    if not hit.size:
        return
    rows, columns = np.divmod(hit, len(x))
    px, py = x[columns], y[rows]

    def linear(vector: np.ndarray) -> np.ndarray:
        value: np.ndarray = np.float32(vector[0]) * px + np.float32(vector[1]) * py
        value += np.float32(vector @ base)
        return value

    t = np.float32(c) / (np.sqrt(inside.ravel()[hit]) - linear(b))
    along = t * linear(axis)
    where = (rows + int(box[1] - top)) * stride + (columns + int(box[0] - left))
    depth, surface, lit = flat
    won = np.flatnonzero((along >= q.low[i]) & (along <= q.high[i]) & (t > 0) & (t < depth[where]))
    t, px, py, where = t[won], px[won], py[won], where[won]
    normal = [t * linear(a[j]) + np.float32(b[j]) for j in range(3)]
    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
    towards = sum(np.float32(light[j]) * normal[j] for j in range(3))
    depth[where], surface[where] = t, i
    lit[where] = towards / np.maximum(length, np.float32(1e-12))
