"""What a camera does, by the fixed points it sees: moves, stands, turns, zooms; or why that cannot be told."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import Kind
from drocap_ros.geometry.rotations import exp_so3, project_to_so3
from drocap_ros.reconstruction.camera.path_model import Views
from drocap_ros.tracks import Tracks


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

    def common(self, first: int, second: int) -> np.ndarray:
        """(2, N, 2) px, where two keyframes see what both see."""
        (a, at_a), (b, at_b) = self.at(first), self.at(second)
        _, in_a, in_b = np.intersect1d(a, b, assume_unique=True, return_indices=True)
        return np.stack([at_a[in_a], at_b[in_b]])


def with_focal(matrix: np.ndarray, factor: float) -> np.ndarray:
    """The camera matrix (3, 3) with focal lengths so many times as long."""
    return np.asarray(matrix * np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]]))


def rays(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Directions (N, 3) of length 1 of points (N, 2) px, in camera axes."""
    plane = (points - matrix[:2, 2]) / np.diagonal(matrix)[:2]
    out = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


def turn_between(both: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) of a camera between two views (2, N, 2) px, robust, and the angles (N,) rad that it leaves."""
    (first, second), weight = (rays(points, matrix) for points in both), np.ones(both.shape[1])
    for _ in range(8):  # steps of reweighting
        rotation = project_to_so3((weight[:, None] * second).T @ first)
        angle = np.linalg.norm(second - first @ rotation.T, axis=1)
        # The residuals' scale is a tenth of a pixel at least, in rad.
        weight = 1.0 / (1.0 + np.square(angle / max(float(np.median(angle)), 1e-4))) ** 2
    return rotation, angle


#: Points with which an image tells.
_LEAST_POINTS = 12


def cut_times(tracks: Tracks) -> list[float]:
    """Times (s) of the cuts in a clip without telemetry, by its fixed points."""
    if tracks.background is None or tracks.camera_rotation is not None:
        return []
    time_s = (tracks.stamp_ns - tracks.stamp_ns[0]) * 1e-9
    return [float(time_s[image]) for image in cuts(tracks.background, time_s)]


def cuts(points: Background, time_s: np.ndarray) -> list[int]:
    """First images of further shots: hardly a point goes on there, or the picture is larger or smaller at once.

    time_s : (F,) of the images
    """
    order = np.argsort(points.frame, kind="stable")
    rows = np.split(order, np.searchsorted(points.frame[order], np.arange(1, len(time_s))))
    pairs = list(pairwise(image for image, seen in enumerate(rows) if len(seen) >= _LEAST_POINTS))
    compared = [_compared(points, rows[before], rows[after]) for before, after in pairs]
    growth = np.array([0.0, *(grown for _, grown in compared), 0.0])
    beside = np.maximum(growth[:-2], growth[2:])
    # A cut to a nearer or farther view of the same scene grows or shrinks at once; the logarithm of the factor is up to
    # 0.04 in clips of drones and hands, with 5 to 60 images a second, and that steadily.
    jumps = growth[1:-1] > np.maximum(0.05, 4.0 * beside)
    # Longest time (s) without points that counts as a cut: a fade; later no point could go on anyway.  Over a cut a few
    # corners of the new image look like those of the old one.
    return [
        before + 1
        for (before, after), (share, _), jump in zip(pairs, compared, jumps, strict=True)
        if (share < 0.05 or jump) and time_s[after] - time_s[before] <= 0.5
    ]


def _compared(points: Background, before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Share of the points that two images have in common, and the size of the logarithm by which most grow apart."""
    common, *places = np.intersect1d(points.track[before], points.track[after], return_indices=True)
    share = len(common) / min(len(before), len(after))
    if len(common) < _LEAST_POINTS:
        return share, 0.0
    # Nearer to their middle points tell no growth: errors of tracks are as large.
    first, second = (
        np.maximum(np.linalg.norm(seen - np.median(seen, axis=0), axis=1), 1.0)
        for seen in (points.point[rows[place]] for rows, place in zip((before, after), places, strict=True))
    )
    return share, float(np.abs(np.median(np.log(second / first))))


#: Points that a pair has at least.
_LEAST_COMMON = 12
#: Share of pairs that have to agree.
_MOST = 0.8


def kind_of(sightings: Sightings, matrix: np.ndarray, key_hz: float, width: int) -> Kind:
    """What the camera does; ``Kind.MOVES`` where nothing simpler explains the points. ``width`` : of the image, px."""
    if cut_at(sightings) is not None:
        return Kind.CUT
    seeing = np.mean([len(rows) >= _LEAST_COMMON for rows in sightings.rows])
    pairs = _pairs(sightings, key_hz)
    if seeing < 0.5 or not pairs:  # half of the keyframes see enough points
        return Kind.FEW_POINTS
    same = width / 1280.0  # px: errors of tracks reach half of it
    # First, as turns and zooms take nearly all of the time: a camera on a tripod is asked in each live window.
    way = np.array([np.median(np.linalg.norm(there - here, axis=1)) for here, there in pairs])
    if np.mean(way < same) >= _MOST and np.mean(way < 2 * same) >= 0.5 * (1.0 + _MOST):
        return Kind.STANDS
    turned, zoomed, zoom = _motion(pairs, matrix)
    if np.mean(turned < same) >= _MOST:
        # What no turn explains either is the tracks' errors: of small images, or behind persons who pass.
        explains = turned[way >= same] < 0.5 * way[way >= same]
        return Kind.TURNS if explains.mean() > 0.5 else Kind.STANDS
    zooms = (zoomed < same) & (np.abs(zoom) > 0.01)  # of the focal length
    if zooms.any() and np.mean(zoomed < same) >= _MOST:
        return Kind.ZOOMS
    return Kind.MOVES


def cut_at(sightings: Sightings, over_gaps: bool = False) -> int | None:
    """Keyframe at which no point of that before goes on, or ``over_gaps`` of the last that sees many; None = none."""
    before = None
    for key in range(len(sightings)):
        tracks = sightings.views.track[sightings.at(key)[0]]
        if len(tracks) >= _LEAST_COMMON:
            if before is not None and not np.isin(tracks, before).any():
                return key
            before = tracks
        elif not over_gaps:
            before = None
    return None


def turning_focal(sightings: Sightings, matrix: np.ndarray, key_hz: float) -> float:
    """Factor on the focal length at which turns explain the points best; for a camera that turns in its place."""
    factors = np.geomspace(0.5, 2.0, 9)
    pairs = _pairs(sightings, key_hz)
    rest = [float(np.median(_motion(pairs, with_focal(matrix, factor))[0])) for factor in factors]
    return float(factors[int(np.argmin(rest))])


def _motion(pairs: list[np.ndarray], matrix: np.ndarray) -> np.ndarray:
    """(3, N) of pairs: what a turn leaves of the points' way (px), what turn and zoom leave (px), zoom."""
    return np.array([_compare(both, matrix) for both in pairs]).reshape(-1, 3).T


def _pairs(sightings: Sightings, key_hz: float) -> list[np.ndarray]:
    """Points (2, N, 2) px that pairs of keyframes have in common."""
    found = []
    for lag_s in (1.0, 3.0):  # between the keyframes of a pair, of which at most 30 are compared
        lag = max(round(lag_s * key_hz), 1)
        last = len(sightings) - 1 - lag
        if last < 0:
            continue
        for first in np.unique(np.linspace(0, last, 30).astype(int)).tolist():
            both = sightings.common(first, first + lag)
            if both.shape[1] >= _LEAST_COMMON:
                found.append(both)
    return found


def _compare(both: np.ndarray, matrix: np.ndarray) -> tuple[float, float, float]:
    focal, (first, second) = float(matrix[0, 0]), both
    rotation, angle = turn_between(both, matrix)
    plane = (second - matrix[:2, 2]) / np.diagonal(matrix)[:2]
    zoom, zoomed = _turn_and_zoom(rays(first, matrix) @ rotation.T, plane)
    return focal * float(np.median(angle)), focal * zoomed, float(np.log(max(zoom, 1e-3)))


def _turn_and_zoom(expected: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Zoom that with a further turn maps directions (N, 3) to places (N, 2), and the median of what remains."""
    zoom, weight = 1.0, np.ones(len(seen))
    for _ in range(6):
        x, y = (expected[:, :2] / np.maximum(expected[:, 2:], 0.1)).T
        rest = seen - zoom * np.stack([x, y], axis=1)
        by_x = np.stack([-x * y * zoom, (1 + x * x) * zoom, -y * zoom, x], axis=1)
        by_y = np.stack([-(1 + y * y) * zoom, x * y * zoom, x * zoom, y], axis=1)
        rows, twice = np.concatenate([by_x, by_y]), np.tile(weight, 2)
        change = np.linalg.lstsq(rows * twice[:, None], rest.T.reshape(-1) * twice, rcond=None)[0]
        expected, zoom = expected @ exp_so3(change[:3]).T, zoom + float(change[3])
        off = np.linalg.norm(rest, axis=1)
        weight = 1.0 / (1.0 + np.square(off / max(float(np.median(off)), 1e-4)))
    return zoom, float(np.median(off))
