"""Simulated scenes of fixed points before a camera that flies by, turns or stands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import log_so3

MATRIX = np.array([[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
SIZE = (1280, 720)


class Scene(NamedTuple):
    """A camera's true path, and what it sees: rotation (F, 3, 3) world -> camera, position (F, 3) m; rows of views."""

    rotation: np.ndarray
    position: np.ndarray
    frame: np.ndarray
    track: np.ndarray
    point: np.ndarray
    fps: float


def looking(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(F, 3, 3) world -> camera of cameras (F, 3) that look at targets (F, 3), z up."""
    forward = target - position
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def orbit(frames: int, fps: float, radius_m: float = 6.0, turn_deg_s: float = 19.0) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions of a camera that flies about the origin, at 2.5 m, uneven in speed and height."""
    time = np.arange(frames) / fps
    angle = np.deg2rad(turn_deg_s) * (time + 0.3 * np.sin(0.9 * time))
    position = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 2.5 + 0.4 * np.sin(0.7 * time)], axis=1)
    target = np.stack([0.3 * np.sin(0.5 * time), 0.2 * np.cos(0.8 * time), np.full(frames, 0.9)], axis=1)
    return looking(position, target), position


def points_of(rng: np.random.Generator, count: int, flat: bool = False) -> np.ndarray:
    """(N, 3) m: ground of 25 m about the origin and, unless ``flat``, things on it."""
    radius, angle = 25.0 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)
    if not flat:
        points[::2, 2] = rng.uniform(0.0, 5.0, len(points[::2]))
    return points


def seen(rotation: np.ndarray, position: np.ndarray, points: np.ndarray, fps: float, longest_s: float = 3.0) -> Scene:
    """What a camera sees of points (N, 3) m; a track ends after ``longest_s`` and the point begins a new one."""
    inside = np.einsum("fij,nfj->fni", rotation, points[:, None] - position)
    depth = np.maximum(inside[..., 2], 0.1)
    pixels = inside[..., :2] / depth[..., None] * np.diagonal(MATRIX)[:2] + MATRIX[:2, 2]
    ok = (inside[..., 2] > 1.0) & (pixels > 0.0).all(-1) & (pixels < SIZE).all(-1)
    frame, point = np.nonzero(ok)
    part = (frame + 7 * point) // round(longest_s * fps)
    return Scene(rotation, position, frame, point * 1000 + part, pixels[frame, point], fps)


def turn_errors_deg(path: np.ndarray, true: np.ndarray, fps: float) -> np.ndarray:
    """Errors of the turns over a second of rotations (F, 3, 3)."""
    lag = int(fps)
    turn, expected = (r[lag:] @ r[:-lag].swapaxes(1, 2) for r in (path, true))
    return np.degrees(np.linalg.norm(log_so3(turn @ expected.swapaxes(1, 2)), axis=1))


def shape_error(path: np.ndarray, true: np.ndarray) -> float:
    """RMS (m) of a path (F, 3) after the best similarity."""
    a, b = path - path.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    fitted = s @ np.diagonal(sign) / np.square(a).sum() * a @ (u @ sign @ vt).T
    return float(np.sqrt(np.square(fitted - b).sum(axis=1).mean()))
