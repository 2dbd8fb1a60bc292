"""The scenery around a simulated person: ground, sky, sun, distant trees and houses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Side of the ground's repeating pattern, near and far; the haze hides the repetitions.
NEAR_M = 24.0
FAR_M = 480.0  # m: twenty near ones
_NEAR_PX = 1024  # px of the pattern: 2.3 cm each, about one px of an image from 20 m
_FAR_PX = 512  # px of the pattern: 0.9 m each; the haze hides finer ones
#: Distances of trees and houses from the origin, beyond the person's path.
_LEAST_M = 32.0
_MOST_M = 95.0  # m; a judgement, as the least

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
    near = _pattern(rng, _NEAR_PX, colour, contrast, patch)
    _paint_lines(rng, near)
    houses, house_colours = _houses(rng, int(rng.integers(2, 9)))
    trees, tree_colours = _trees(rng, int(rng.integers(6, 26)))
    far_colour = near.reshape(-1, 3).mean(axis=0)
    return Scenery(
        near=_packed(near),
        far=_packed(_pattern(rng, _FAR_PX, far_colour, 12.0, 24)),
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
    distance, bearing = rng.uniform(_LEAST_M, _MOST_M, count), rng.uniform(-np.pi, np.pi, count)
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
