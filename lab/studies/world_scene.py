"""Fixed points of a simulated scene, followed through the images of the world protocol as optical flow does it.

Ground with low waves, bushes and walls about the person; about 150 points at a time, each for 0.3 to 6 s, none near the
person in the image.  The noise is 0.4 px, tracks drift by 0.03 px a frame, and 6 % of them slide or lie on things that
move.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background

#: Points at a time.
_ALIVE = 150
#: Shortest and longest life of a track, s.
_LIFE_S = (0.3, 6.0)
#: Noise of an observation px, steps of its drift px per frame, share of tracks that slide, their speed px per frame.
_NOISE_PX = 0.4
_DRIFT_PX = 0.03
_SLIDING = 0.06
_SLIDE_PX = 0.6
#: Points of the ground and their farthest distance m; the height of its waves m.
_GROUND = 6000
_GROUND_M = 60.0
_WAVES_M = 0.08
#: Bushes and walls: their number, points of each, half the side of the square they stand in m, none nearer than m.
_THINGS = 60
_POINTS = 40
_SIDE_M = 45.0
_CLEAR_M = 11.0
#: Spread of a thing's points m, and its least and largest height m.
_SPREAD_M = 0.6
_HIGH_M = (1.0, 6.0)
#: No track lies nearer to the person's box, nor to the image's edge, px; nor nearer to the camera, m.
_PERSON_PX = 25.0
_EDGE_PX = 4.0
_NEAREST_M = 1.0


class PinholePath(NamedTuple):
    """The camera that sees: position (F, 3) m, rotation (F, 3, 3) world -> camera, focal length px, image size px."""

    position: np.ndarray
    rotation: np.ndarray
    focal_px: float
    size: tuple[int, int]

    def see(self, points: np.ndarray, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Places (N, 2) px of points (N, 3) m in one image, and whether they lie in it (N,)."""
        seen = (points - self.position[frame]) @ self.rotation[frame].T
        size = np.array(self.size)
        px = seen[:, :2] / np.maximum(seen[:, 2:], 0.1) * self.focal_px + size / 2
        inside = (seen[:, 2] > _NEAREST_M) & (px > _EDGE_PX).all(axis=1) & (px < size - _EDGE_PX).all(axis=1)
        return px, inside


def scene_points(rng: np.random.Generator, centre: np.ndarray) -> np.ndarray:
    """(N, 3) m points of ground and things about a centre (2,) m."""
    distance, bearing = _GROUND_M * np.sqrt(rng.random(_GROUND)), 2 * np.pi * rng.random(_GROUND)
    x, y = centre[0] + distance * np.cos(bearing), centre[1] + distance * np.sin(bearing)
    ground = np.column_stack([x, y, _WAVES_M * np.sin(x / 1.7) * np.cos(y / 2.3)])
    foot = rng.uniform(-_SIDE_M, _SIDE_M, (_THINGS, 2)) + centre
    foot = foot[np.linalg.norm(foot - centre, axis=1) > _CLEAR_M]
    flat = foot[:, None] + rng.normal(0.0, _SPREAD_M, (len(foot), _POINTS, 2))
    height = rng.random((len(foot), _POINTS, 1)) * rng.uniform(*_HIGH_M, (len(foot), 1, 1))
    return np.concatenate([ground, np.concatenate([flat, height], axis=-1).reshape(-1, 3)])


def followed_points(path: PinholePath, person: np.ndarray, fps: float, seed: int) -> Background:
    """Tracks of the points about a person (F, P, 3) m; the scene and every error are drawn from the seed."""
    rng = np.random.default_rng([seed, _GROUND])
    points = scene_points(rng, person[:, 0, :2].mean(axis=0))
    track = np.full(len(points), -1)
    ends, offset, slide = np.zeros(len(points)), np.zeros((len(points), 2)), np.zeros((len(points), 2))
    begun, rows = 0, []
    for frame in range(len(person)):
        px, visible = path.see(points, frame)
        body, _ = path.see(person[frame], frame)
        low, high = body.min(axis=0) - _PERSON_PX, body.max(axis=0) + _PERSON_PX
        visible &= ~((px > low) & (px < high)).all(axis=1)
        track[~visible | (ends <= frame)] = -1
        free = np.flatnonzero(visible & (track < 0))
        new = rng.permutation(free)[: max(_ALIVE - int((track >= 0).sum()), 0)]
        track[new] = begun + np.arange(len(new))
        begun += len(new)
        ends[new] = frame + (fps * rng.uniform(*_LIFE_S, len(new))).astype(int)
        slides = rng.random((len(new), 1)) < _SLIDING
        offset[new], slide[new] = 0.0, np.where(slides, rng.normal(0.0, _SLIDE_PX, (len(new), 2)), 0.0)
        alive = np.flatnonzero(track >= 0)
        offset[alive] += rng.normal(0.0, _DRIFT_PX, (len(alive), 2)) + slide[alive]
        noise = rng.normal(0.0, _NOISE_PX, (len(alive), 2))
        rows.append((np.full(len(alive), frame), track[alive], px[alive] + offset[alive] + noise))
    frames, tracks, seen = (np.concatenate(column) for column in zip(*rows, strict=True))
    return Background(frames.astype(np.int32), tracks.astype(np.int64), seen.astype(np.float32))
