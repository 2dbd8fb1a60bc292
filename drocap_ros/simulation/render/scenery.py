"""The scenery around a simulated person: ground, sky, sun, distant trees and houses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Corners of the octagon for a circle of radius 1.
_CIRCLE = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)


def draw_background(
    scene: Scenery, matrix: np.ndarray, width: int, height: int, rotation: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """(height, width, 3) uint8 BGR of the scenery without the person.

    matrix (3, 3) px; rotation (3, 3) world -> camera; position (3,) m, above the ground.
    """
    import cv2

    image = _draw_ground_and_sky(scene, matrix, width, height, rotation, position)
    light = float(np.clip(0.75 + 0.4 * scene.sunlight, 0, 1))
    _draw_trees(scene, image, matrix, rotation, position, light)
    _draw_houses(scene, image, matrix, rotation, position, light)
    return cv2.GaussianBlur(image, (3, 3), 0.6)


def _draw_ground_and_sky(
    scene: Scenery, matrix: np.ndarray, width: int, height: int, rotation: np.ndarray, position: np.ndarray
) -> np.ndarray:
    import cv2

    rays = rotation.T @ np.linalg.inv(matrix)  # pixel -> ray in the world
    rise = _affine(rays[2], width, height)
    near = _ground(scene.near, NEAR_M, rays, position, _distance(rise, position))
    # Far ground, haze and sky vary slowly over the image: a quarter of the resolution is enough.
    coarse = matrix / 4
    coarse[2] = matrix[2]
    rays = rotation.T @ np.linalg.inv(coarse)
    small_rise = _affine(rays[2], -(-width // 4), -(-height // 4))
    distance = _distance(small_rise, position)
    far = _ground(scene.far, FAR_M, rays, position, distance)
    clear = np.exp(-distance / np.float32(scene.haze_m))
    far = cv2.blendLinear(far, np.full_like(far, np.clip(scene.horizon, 0, 255).astype(np.uint8)), clear, 1 - clear)
    # A longer focal length keeps the fine pattern to a larger distance.
    focal = max(0.5 * float(matrix[0, 0] + matrix[1, 1]), 1.0)
    # Over 14 m the fine pattern of the ground fades into the coarse one.
    fine = cv2.resize(np.exp(-distance * np.float32(600 / (14.0 * focal))), (width, height))
    image = cv2.blendLinear(near, cv2.resize(far, (width, height)), fine, 1 - fine)
    sky = cv2.resize(_sky(scene, small_rise), (width, height))
    return np.asarray(cv2.copyTo(sky, (rise >= 0).view(np.uint8), image))


def _distance(rise: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(h, w) float32 to the ground along rays that rise by ``rise`` m per unit; very far for rays that do not fall."""
    return np.asarray(np.float32(max(float(position[2]), 0.05)) / np.maximum(-rise, np.float32(1e-4)))


def _affine(row: np.ndarray, width: int, height: int) -> np.ndarray:
    """(height, width) float32, row[0] u + row[1] v + row[2] over the pixels."""
    across = (row[0] * np.arange(width) + row[2]).astype(np.float32)
    value: np.ndarray = (row[1] * np.arange(height)).astype(np.float32)[:, None] + across
    return value


def _ground(
    pattern: np.ndarray, size_m: float, rays: np.ndarray, position: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """(h, w, 3) uint8, nearest pixels of a repeating pattern (S, S) packed BGRX, S a power of two.

    rays (3, 3) pixel -> ray in the world; distance (h, w) to the ground in units of the ray.
    """
    import cv2

    height, width = distance.shape
    side = len(pattern)
    index = np.zeros((height, width), np.int32)
    for axis in (1, 0):
        at = _affine(rays[axis] * (side / size_m), width, height)
        at *= distance
        at += np.float32(position[axis] * side / size_m % side + 128 * side)
        # The offset of 128 repetitions keeps the numbers positive; haze covers everything farther away.
        np.clip(at, 0, 256 * side, out=at)
        index *= side
        index += at.astype(np.int32) & (side - 1)
    packed = np.take(pattern.ravel(), index)
    return np.asarray(cv2.cvtColor(packed.view(np.uint8).reshape(height, width, 4), cv2.COLOR_BGRA2BGR))


def _sky(scene: Scenery, rise: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 sky by the height over the horizon, from a table of 256 colours."""
    import cv2

    step = np.linspace(0, 1, 256)[:, None]
    table = np.clip(scene.horizon * (1 - step) + scene.zenith * step, 0, 255).astype(np.uint8)
    level = np.clip(rise * np.float32(255 / 0.7), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(cv2.merge([level] * 3), table[None]))


def _projected(
    points: np.ndarray, matrix: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(..., 2) px and (...) depth m of world points (..., 3)."""
    local = (points - position) @ rotation.T
    depth = local[..., 2]
    return (local @ matrix.T)[..., :2] / np.maximum(depth, 1e-3)[..., None], depth


def _hazed(scene: Scenery, colour: np.ndarray, distance: float, light: float) -> tuple[float, float, float]:
    clear = np.exp(-distance / scene.haze_m)
    mixed = np.clip(colour * light, 0, 255) * clear + scene.horizon * (1 - clear)
    return float(mixed[0]), float(mixed[1]), float(mixed[2])


def _draw_trees(
    scene: Scenery, image: np.ndarray, matrix: np.ndarray, rotation: np.ndarray, position: np.ndarray, light: float
) -> None:
    import cv2

    height, radius = scene.trees[:, 2], scene.trees[:, 3]
    share = np.array([0.0, 0.55, 0.7, 0.85])  # foot, then the centres of three crowns
    points = np.zeros((len(scene.trees), 4, 3))
    points[..., :2] = scene.trees[:, None, :2]
    points[..., 2] = height[:, None] * share
    px, depth = _projected(points, matrix, rotation, position)
    focal = matrix[0, 0]
    for i in np.argsort(-depth[:, 0]):
        if depth[i].min() < 1.0 or np.abs(px[i]).max() > 16000:
            continue
        at = np.round(px[i]).astype(int)
        distance = float(depth[i, 0])
        trunk = _hazed(scene, np.array([50.0, 65.0, 85.0]), distance, light)
        thick = max(1, round(0.1 * radius[i] * 2 * focal / distance))
        cv2.line(image, tuple(at[0].tolist()), tuple(at[2].tolist()), trunk, thick)
        for k, (size, shade) in enumerate(((1.0, 0.75), (0.85, 0.9), (0.6, 1.1)), start=1):
            colour = _hazed(scene, scene.tree_colours[i] * shade, distance, light)
            cv2.circle(image, tuple(at[k].tolist()), max(1, round(size * radius[i] * focal / distance)), colour, -1)


def _draw_houses(
    scene: Scenery, image: np.ndarray, matrix: np.ndarray, rotation: np.ndarray, position: np.ndarray, light: float
) -> None:
    import cv2

    px, depth = _projected(scene.houses, matrix, rotation, position)
    for i in np.argsort(-depth.mean(axis=1)):
        if depth[i].min() < 1.0 or np.abs(px[i]).max() > 16000:
            continue
        corners = np.round(px[i]).astype(np.int32)
        distance = float(depth[i].mean())
        walls = [(k, (k + 1) % 4) for k in range(4)]
        for k, m in sorted(walls, key=lambda w: -float(depth[i, w[0]] + depth[i, w[1]])):
            wall_along = scene.houses[i, m] - scene.houses[i, k]
            outward = np.array([wall_along[1], -wall_along[0], 0.0])
            lit = 0.75 + 0.35 * float(outward @ scene.sun) / max(float(np.linalg.norm(outward)), 1e-6)
            wall = corners[[k, m, m + 4, k + 4]]
            cv2.fillConvexPoly(image, wall, _hazed(scene, scene.house_colours[i], distance, lit * light))
        roof = cv2.convexHull(corners[4:])
        if position[2] > scene.houses[i, 4, 2]:
            cv2.fillConvexPoly(image, roof, _hazed(scene, 0.8 * scene.house_colours[i], distance, light))


def draw_shadow(
    scene: Scenery,
    image: np.ndarray,
    ends: np.ndarray,
    reach: np.ndarray,
    matrix: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
) -> None:
    """Darken the ground in the shadow of bodies.

    ends (N, 2, 3) m and reach (N,) m: pairs of spheres in the world, whose hulls are the bodies
    """
    import cv2

    height, width = image.shape[:2]
    across = np.array([scene.sun[1], -scene.sun[0], 0.0])
    across /= max(float(np.linalg.norm(across)), 1e-6)
    other = np.cross(across, scene.sun)
    circle = _CIRCLE[:, :1] * across + _CIRCLE[:, 1:] * other
    rim = ends[:, :, None] + reach[:, None, None, None] * circle
    rim = rim - scene.sun * (rim[..., 2:] / scene.sun[2])
    px, depth = _projected(rim.reshape(len(ends), -1, 3), matrix, rotation, position)
    fine = (depth.min(axis=1) > 0.3) & (np.abs(px).max(axis=(1, 2)) < 16000)
    if not fine.any():
        return
    shapes = np.round(px[fine]).astype(np.int32)
    low = np.clip(shapes.min(axis=(0, 1)) - 3, 0, [width, height])
    high = np.clip(shapes.max(axis=(0, 1)) + 4, 0, [width, height])
    if (high <= low).any():
        return
    mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.float32)
    for shape in shapes:
        cv2.fillConvexPoly(mask, cv2.convexHull(shape - low.astype(np.int32)), 1.0)
    strength = (1 - scene.shade) * min(1.0, scene.sunlight / 0.5)
    part = image[low[1] : high[1], low[0] : high[0]]
    weight = 1 - np.float32(strength) * cv2.GaussianBlur(mask, (5, 5), 0)
    part[:] = cv2.blendLinear(part, np.zeros_like(part), weight, 1 - weight)


#: Side of the ground's repeating pattern, near and far; the haze hides the repetitions.
NEAR_M = 24.0
FAR_M = 480.0  # m: twenty near ones

_GROUNDS = (  # base colour BGR, its variation, size of its patches in px of the pattern
    ((60, 115, 85), 22.0, 40),  # grass
    ((85, 140, 125), 26.0, 90),  # dry grass
    ((110, 112, 115), 10.0, 60),  # asphalt
    ((130, 165, 190), 14.0, 50),  # sand
    ((150, 155, 160), 8.0, 120),  # concrete
    ((60, 75, 135), 10.0, 100),  # a running track
    ((55, 75, 95), 22.0, 30),  # earth
    ((205, 205, 200), 10.0, 80),  # snow
)
_SKIES = (  # at the horizon, overhead, share of direct sunlight
    ((235, 215, 190), (205, 140, 80), 0.55),
    ((225, 220, 215), (190, 185, 180), 0.12),
    ((190, 205, 235), (170, 130, 90), 0.45),
    ((215, 205, 195), (160, 120, 75), 0.6),
)


@dataclass(frozen=True)
class Scenery:
    """Scenery, m, ENU, with the ground at z = 0.

    near, far : (S, S) uint32, packed BGRX patterns of the ground that repeat every NEAR_M and FAR_M
    horizon, zenith : (3,) BGR colours of the sky
    sun : (3,) unit vector towards the sun; sunlight : its share of the light
    shade : brightness of the ground in the shadow, with all light from the sun
    haze_m : distance at which the haze replaces 63 % of the colour
    houses : (H, 8, 3) m corners, the first four on the ground; house_colours (H, 3)
    trees : (T, 4) x, y, height, radius of the crown, m; tree_colours (T, 3)
    """

    near: np.ndarray
    far: np.ndarray
    horizon: np.ndarray
    zenith: np.ndarray
    sun: np.ndarray
    sunlight: float
    haze_m: float
    houses: np.ndarray
    house_colours: np.ndarray
    trees: np.ndarray
    tree_colours: np.ndarray
    shade: float = 0.62


def make_scenery(seed: int) -> Scenery:
    """Scenery of a seed."""
    rng = np.random.default_rng([seed, 0x5CE])
    base, contrast, patch = _GROUNDS[rng.integers(len(_GROUNDS))]
    colour = np.array(base, float) * rng.uniform(0.8, 1.15)
    horizon, zenith, sunlight = _SKIES[rng.integers(len(_SKIES))]
    height, bearing = np.deg2rad(rng.uniform(25, 70)), rng.uniform(-np.pi, np.pi)
    sun = np.array([np.cos(height) * np.cos(bearing), np.cos(height) * np.sin(bearing), np.sin(height)])
    near = _pattern(rng, 1024, colour, contrast, patch)  # 2.3 cm a px: about one px of an image from 20 m
    _paint_lines(rng, near)
    houses, house_colours = _houses(rng, int(rng.integers(2, 9)))
    trees, tree_colours = _trees(rng, int(rng.integers(6, 26)))
    far_colour = near.reshape(-1, 3).mean(axis=0)
    return Scenery(
        near=_packed(near),
        far=_packed(_pattern(rng, 512, far_colour, 12.0, 24)),  # 0.9 m a px: the haze hides finer ones
        horizon=np.array(horizon, float),
        zenith=np.array(zenith, float),
        sun=sun,
        sunlight=sunlight,
        haze_m=float(rng.uniform(60, 220)),
        houses=houses,
        house_colours=house_colours,
        trees=trees,
        tree_colours=tree_colours,
    )


def _packed(pattern: np.ndarray) -> np.ndarray:
    """(S, S, 3) uint8 -> (S, S) uint32: one look-up per pixel."""
    full = np.zeros((*pattern.shape[:2], 4), np.uint8)
    full[..., :3] = pattern
    return full.view(np.uint32)[..., 0]


def _pattern(rng: np.random.Generator, side: int, colour: np.ndarray, contrast: float, patch: int) -> np.ndarray:
    """Noise of several sizes around a colour; it repeats without a seam."""
    import cv2

    total = np.zeros((side, side), np.float32)
    for size, share in ((patch, 0.7), (max(patch // 6, 2), 0.45), (1, 0.35)):
        small = rng.standard_normal((max(side // size, 2),) * 2).astype(np.float32)
        wrapped = np.pad(small, 2, mode="wrap")
        scale = side / len(small)
        large = cv2.resize(wrapped, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        start = round(2 * scale)
        total += np.float32(share) * large[start : start + side, start : start + side]
    tint = np.array([0.9, 1.0, 1.05]) * contrast
    return np.clip(colour + total[..., None] * tint, 0, 255).astype(np.uint8)


def _paint_lines(rng: np.random.Generator, near: np.ndarray) -> None:
    """Add markings, slabs or stains of visible size."""
    import cv2

    side = len(near)
    for _ in range(rng.integers(0, 5)):
        at = int(rng.integers(side))
        colour = tuple(float(v) for v in np.clip(near.reshape(-1, 3).mean(axis=0) + rng.uniform(-70, 70, 3), 0, 255))
        width = int(rng.integers(2, 9))
        ends = ((at, 0), (at, side)) if rng.random() < 0.5 else ((0, at), (side, at))
        cv2.line(near, ends[0], ends[1], colour, width, cv2.LINE_AA)
    for _ in range(rng.integers(0, 12)):
        centre = rng.integers(30, side - 30, 2)
        shift = rng.uniform(-45, 45)
        colour = tuple(float(v) for v in np.clip(near[centre[1], centre[0]] + shift, 0, 255))
        half = (int(rng.integers(3, 28)), int(rng.integers(3, 28)))
        cv2.ellipse(near, tuple(int(v) for v in centre), half, float(rng.uniform(0, 180)), 0, 360, colour, -1)


def _places(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2) m around the origin."""
    # Beyond the person's path, m; a judgement.
    distance, bearing = rng.uniform(32.0, 95.0, count), rng.uniform(-np.pi, np.pi, count)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=1)


def _houses(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    place, turn = _places(rng, count), rng.uniform(0, np.pi, count)
    half = rng.uniform(2.0, 7.0, (count, 2))
    corner = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half[:, None]
    cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
    flat = np.stack([cos * corner[..., 0] - sin * corner[..., 1], sin * corner[..., 0] + cos * corner[..., 1]], -1)
    flat = flat + place[:, None]
    height = rng.uniform(2.5, 9.0, count)[:, None, None] * np.array([0.0, 1.0])[:, None]
    levels = [np.concatenate([flat, np.broadcast_to(height[:, i : i + 1], (count, 4, 1))], axis=2) for i in (0, 1)]
    return np.concatenate(levels, axis=1), rng.uniform(70, 220, (count, 3))


def _trees(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    height = rng.uniform(3.0, 11.0, count)
    shape = np.stack([height, height * rng.uniform(0.16, 0.32, count)], axis=1)
    colours = np.array([45.0, 90.0, 60.0]) * rng.uniform(0.6, 1.3, (count, 1)) + rng.uniform(-12, 12, (count, 3))
    return np.concatenate([_places(rng, count), shape], axis=1), colours
