"""Fixed points at the keyframes of a recording, and how the camera turns between two of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import project_to_so3
from drocap_ros.reconstruction.camera.views import Views

#: Steps of reweighting of a turn, and the least scale (rad) of its residuals: a tenth of a pixel.
_TURN_STEPS = 8
_LEAST_ANGLE = 1e-4


class Common(NamedTuple):
    """What two keyframes both see: piece (N,), and where, (N, 2) px each."""

    piece: np.ndarray
    first: np.ndarray
    second: np.ndarray


class Sightings:
    """Views (of pieces of tracks) at keyframes (K,), frames in ascending order."""

    def __init__(self, views: Views, frames: np.ndarray) -> None:
        self.views, self.frames = views, frames
        order, _ = views.by_frame
        bounds = np.searchsorted(views.frame[order], np.stack([frames, frames + 1]))
        self.rows = [order[begin:end] for begin, end in bounds.T.tolist()]

    @cached_property
    def at_keys(self) -> Views:
        """The views at the keyframes alone, as frames 0 to K - 1."""
        key = np.full(self.views.frames, -1)
        key[self.frames] = np.arange(len(self))
        views, _ = self.views.at_frames(key >= 0)
        return replace(views, frame=key[views.frame], frames=len(self))

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, key: int) -> tuple[np.ndarray, np.ndarray]:
        """Pieces (N,), ascending, and where they are seen, (N, 2) px."""
        rows = self.rows[key]
        return self.views.piece[rows], self.views.point[rows]

    def common(self, first: int, second: int) -> Common:
        """What both keyframes see."""
        (a, at_a), (b, at_b) = self.at(first), self.at(second)
        both, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
        return Common(both, at_a[in_a], at_b[in_b])


def rays(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Directions (N, 3) of length 1 of points (N, 2) px, in camera axes."""
    plane = (points - matrix[:2, 2]) / np.diagonal(matrix)[:2]
    out = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def turn_between(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) that best maps directions (N, 3) to others, robust, and the angles (N,) rad that remain."""
    weight = np.ones(len(first))
    for _ in range(_TURN_STEPS):
        rotation = project_to_so3((weight[:, None] * second).T @ first)
        angle = np.linalg.norm(second - first @ rotation.T, axis=1)
        weight = 1.0 / (1.0 + np.square(angle / max(float(np.median(angle)), _LEAST_ANGLE))) ** 2
    return rotation, angle
