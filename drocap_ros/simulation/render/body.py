"""Surfaces of a simulated person around the joints of ``BODY_17``, and their colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drocap_ros.skeleton import BODY_17

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

    quadrics : in the camera's frame (x right, y down, z forward)
    matrix : (3, 3) px without skew, pixel centres at whole numbers
    width, height : px of the image
    light : (3,) unit, towards the light, in the camera's frame
    returns : the part of the image with the surfaces; its light is the cosine between normal and light (-1 to 1).
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


#: Part of the look, centre (3,) m, axes (3, 3), half lengths for 1.75 m stature, and the factor of these.
_Solid = tuple[str, np.ndarray, np.ndarray, tuple[float, float, float], float]

#: From joint, to joint, radius at both (m at 1.75 m stature), part of the look.
_LIMBS = (
    ("hip", "knee", 0.083, 0.056, "thigh"),
    ("knee", "ankle", 0.056, 0.040, "shank"),
    ("shoulder", "elbow", 0.050, 0.041, "upper_arm"),
    ("elbow", "wrist", 0.041, 0.029, "forearm"),
)
#: Joint, radius of its ball (m at 1.75 m stature), part of the look.
_JOINTS = (
    ("hip", 0.083, "thigh"),
    ("knee", 0.057, "shank"),
    ("ankle", 0.041, "shank"),
    ("shoulder", 0.058, "upper_arm"),
    ("elbow", 0.041, "forearm"),
)
#: Part of the look, place forward, left, up of the head's joint, half lengths, m at 1.75 m stature.
_HEAD = (
    ("skin", (0.008, 0.0, -0.015), (0.098, 0.078, 0.120)),
    ("hair", (-0.024, 0.0, 0.018), (0.098, 0.085, 0.112)),
    ("nose", (0.105, 0.0, -0.025), (0.018, 0.013, 0.020)),
    ("eyes", (0.090, 0.032, 0.005), (0.014, 0.014, 0.010)),
    ("eyes", (0.090, -0.032, 0.005), (0.014, 0.014, 0.010)),
    ("skin", (0.0, 0.080, -0.015), (0.020, 0.012, 0.030)),
    ("skin", (0.0, -0.080, -0.015), (0.020, 0.012, 0.030)),
)
#: Length of the bones below over which the radii are scaled, m at 1.75 m stature (both thighs and shanks).
_LEG_M = 0.491 * 1.75
#: Tip of a shoe before and below the ankle, m at 1.75 m stature.
_TIP = (0.197, 0.038)


@dataclass(frozen=True)
class Look:
    """Colours (3,) BGR 0-255 of the parts of a person, and the factor of its girth (1 = slim average)."""

    colours: dict[str, np.ndarray]
    girth: float


_SKINS = ((180, 205, 240), (150, 185, 225), (120, 160, 210), (85, 125, 175), (60, 85, 130), (45, 60, 90))
_HAIRS = ((30, 35, 45), (20, 20, 22), (40, 65, 105), (75, 130, 185), (120, 120, 125), (35, 50, 125))


def dress(seed: int) -> Look:
    """Look of a person; the same seed gives the same."""
    rng = np.random.default_rng([seed, 0x5EE])
    skin = np.array(_SKINS[rng.integers(len(_SKINS))], float)
    hair = np.array(_HAIRS[rng.integers(len(_HAIRS))], float)
    shirt, trousers, shoes, front = (_cloth(rng) for _ in range(4))
    long_sleeves, long_legs = rng.random() < 0.5, rng.random() < 0.75
    jacket = rng.random() < 0.5
    colours = {"skin": skin, "hair": hair, "nose": 0.85 * skin, "eyes": np.array([30.0, 30.0, 30.0])}
    colours |= {"shirt": shirt, "trousers": trousers, "shoes": shoes, "front": front if jacket else shirt}
    colours |= {"upper_arm": shirt, "forearm": shirt if long_sleeves else skin}
    colours |= {"thigh": trousers, "shank": trousers if long_legs else skin}
    return Look(colours, float(rng.uniform(0.85, 1.2)))


def _cloth(rng: np.random.Generator) -> np.ndarray:
    import colorsys

    hue, saturation, value = rng.random(), rng.random() ** 1.5, rng.uniform(0.08, 0.95)
    return 255 * np.array(colorsys.hsv_to_rgb(hue, saturation, value))[::-1]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product; ``np.cross`` takes ten times as long for one pair."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _axes(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3, 3) rows forward, left, up of a body part."""
    up = _unit(up)
    forward = _unit(_cross(left, up))
    return np.stack([forward, _cross(up, forward), up])


def body(joints: np.ndarray, look: Look) -> tuple[Quadrics, list[str]]:
    """Surfaces of one person in the frame of its joints, and the part of the look of each.

    joints : (17, 3) m, ``BODY_17``, or its first 15, in a frame with z up
    """
    at = dict(zip(BODY_17.joints, joints, strict=False))
    leg = sum(np.linalg.norm(at[s + a] - at[s + b]) for s in "lr" for a, b in (("hip", "knee"), ("knee", "ankle")))
    unit = 0.5 * float(leg) / _LEG_M  # metres of this person per metre of one of 1.75 m
    stout, trunk = unit * look.girth, at["neck"] - at["pelvis"]
    up = _unit(trunk)
    limbs = [(part, at[s + a], at[s + b], r0 * stout, r1 * stout) for s in "lr" for a, b, r0, r1, part in _LIMBS]
    limbs.append(("shirt", at["lshoulder"], at["rshoulder"], 0.058 * stout, 0.058 * stout))
    limbs.append(("skin", at["neck"] - 0.10 * unit * up, at["head"], 0.062 * stout, 0.055 * stout))
    sides, starts, ends, *radii = zip(*limbs, strict=True)
    hips, chest = (_axes(at["l" + joint] - at["r" + joint], trunk) for joint in ("hip", "shoulder"))
    front = at["pelvis"] + 0.56 * trunk + 0.055 * stout * chest[0]
    solids: list[_Solid] = [
        *((part, at[s + joint], np.eye(3), (r, r, r), stout) for s in "lr" for joint, r, part in _JOINTS),
        ("trousers", at["pelvis"] + 0.02 * unit * up, hips, (0.115, 0.165, 0.125), stout),
        ("shirt", at["pelvis"] + 0.34 * trunk, hips, (0.108, 0.148, 0.21), stout),
        ("shirt", at["pelvis"] + 0.62 * trunk, chest, (0.122, 0.178, 0.215), stout),
        ("front", front, chest, (0.072, 0.062, 0.21), stout),
        *_head(at, 0.5 * (hips + chest), unit),
        *(solid for side in "lr" for solid in (_hand(at, side, hips, unit), _shoe(at, side, hips, unit))),
    ]
    parts, centres, axes, shapes, widths = zip(*solids, strict=True)
    halves = np.array(shapes) * np.array(widths)[:, None]
    tapered = cones(np.array(starts), np.array(ends), np.array(radii[0]), np.array(radii[1]))
    return joined([tapered, ellipsoids(np.array(centres), np.array(axes), halves)]), [*sides, *parts]


def _head(at: dict[str, np.ndarray], facing: np.ndarray, unit: float) -> list[_Solid]:
    """Head with the body's direction; the hair is behind and above the face."""
    frame = _axes(facing[1], at["head"] - at["neck"])
    forward, left, up = frame
    return [
        (part, at["head"] + unit * (x * forward + y * left + z * up), frame, half, unit)
        for part, (x, y, z), half in _HEAD
    ]


def _hand(at: dict[str, np.ndarray], side: str, hips: np.ndarray, unit: float) -> _Solid:
    arm = _unit(at[side + "wrist"] - at[side + "elbow"])
    across = _unit(_cross(arm, hips[0] + 0.01 * hips[2]))
    hand = np.stack([arm, across, _cross(arm, across)])
    return "skin", at[side + "wrist"] + 0.075 * unit * arm, hand, (0.095, 0.024, 0.045), unit


def _shoe(at: dict[str, np.ndarray], side: str, hips: np.ndarray, unit: float) -> _Solid:
    ankle = at[side + "ankle"]
    sole = _sole(at, side, hips, unit)
    return "shoes", ankle + unit * (0.062 * sole[0] - 0.038 * sole[2]), sole, (0.135, 0.048, 0.045), unit


def _sole(at: dict[str, np.ndarray], side: str, hips: np.ndarray, unit: float) -> np.ndarray:
    """(3, 3) rows forward, left, up of a shoe: towards the toe, or without one square to the shank."""
    ankle = at[side + "ankle"]
    shank = _unit(ankle - at[side + "knee"])
    if side + "toe" in at:
        tip = _unit(at[side + "toe"] - ankle)
        across = _unit(_cross(-shank, tip))
        # The tip lies below the middle line of the shoe.
        toes = _unit(_TIP[0] * tip + _TIP[1] * _cross(tip, across))
        return _axes(across, _cross(toes, across))
    toes = _unit(hips[0] - (hips[0] @ shank) * shank)
    # The toes stay above the ground.
    drop = max((0.035 * unit - ankle[2]) / (0.19 * unit), -0.95)
    if toes[2] < drop:
        flat = _unit(np.array([toes[0], toes[1], 0.0]))
        toes = np.append(flat[:2] * np.sqrt(1 - min(drop, 0.95) ** 2), min(drop, 0.95))
    return _axes(_cross(-shank, toes), _cross(toes, _cross(-shank, toes)))
