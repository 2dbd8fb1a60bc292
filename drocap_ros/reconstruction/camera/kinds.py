"""What a camera does, by the fixed points it sees: moves, stands, turns, zooms; or why that cannot be told."""

from __future__ import annotations

import numpy as np

from drocap_ros.camera_path import Kind
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.camera.sightings import Common, Sightings, rays, turn_between

#: Times (s) between the keyframes that are compared, and most pairs of each.
_LAGS_S = (1.0, 3.0)
_PAIRS = 30
#: Points that a pair has at least.
_LEAST_COMMON = 12
#: Motion (px of an image 1280 wide) of points before a camera that stands, or that a turn does not explain: errors of
#: tracks reach half of it.
_SAME_PX = 1.0
_REFERENCE_WIDTH = 1280.0
#: Change of the focal length from which a camera zooms, and steps to find it.
_ZOOM = 0.01
_ZOOM_STEPS = 6
#: Factors on the focal length that are tried for a camera that turns: least, largest, how many.
_FOCALS = (0.5, 2.0, 9)
#: What a turn leaves of the points' way where it explains it.
_EXPLAINED = 0.5
#: Share of pairs that have to agree.
_MOST = 0.8
#: Share of keyframes that see enough points, at least.
_SEEING = 0.5


def kind_of(sightings: Sightings, matrix: np.ndarray, key_hz: float, width: int) -> Kind:
    """What the camera does; ``Kind.MOVES`` where nothing simpler explains the points. ``width`` : of the image, px."""
    if cut_at(sightings) is not None:
        return Kind.CUT
    seeing = np.mean([len(rows) >= _LEAST_COMMON for rows in sightings.rows])
    pairs = _pairs(sightings, key_hz)
    if seeing < _SEEING or not pairs:
        return Kind.FEW_POINTS
    same = _SAME_PX * width / _REFERENCE_WIDTH
    # First, as turns and zooms take nearly all of the time: a camera on a tripod is asked in each live window.
    way = np.array([np.median(np.linalg.norm(both.second - both.first, axis=1)) for both in pairs])
    if np.mean(way < same) >= _MOST and np.mean(way < 2 * same) >= 0.5 * (1.0 + _MOST):
        return Kind.STANDS
    turned, zoomed, zoom = _motion(pairs, matrix)
    if np.mean(turned < same) >= _MOST:
        # What no turn explains either is the tracks' errors: of small images, or behind persons who pass.
        explains = turned[way >= same] < _EXPLAINED * way[way >= same]
        return Kind.TURNS if explains.mean() > 0.5 else Kind.STANDS
    zooms = (zoomed < same) & (np.abs(zoom) > _ZOOM)
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
    factors = np.geomspace(*_FOCALS)
    rest, pairs = [], _pairs(sightings, key_hz)
    for factor in factors:
        other = matrix * np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])
        rest.append(float(np.median(_motion(pairs, other)[0])))
    return float(factors[int(np.argmin(rest))])


def _motion(pairs: list[Common], matrix: np.ndarray) -> np.ndarray:
    """(3, N) of pairs: what a turn leaves of the points' way (px), what turn and zoom leave (px), zoom."""
    return np.array([_compare(both, matrix) for both in pairs]).reshape(-1, 3).T


def _pairs(sightings: Sightings, key_hz: float) -> list[Common]:
    """Points that pairs of keyframes have in common."""
    found = []
    for lag_s in _LAGS_S:
        lag = max(round(lag_s * key_hz), 1)
        last = len(sightings) - 1 - lag
        if last < 0:
            continue
        for first in np.unique(np.linspace(0, last, _PAIRS).astype(int)).tolist():
            both = sightings.common(first, first + lag)
            if len(both.piece) >= _LEAST_COMMON:
                found.append(both)
    return found


def _compare(both: Common, matrix: np.ndarray) -> tuple[float, float, float]:
    focal, first = float(matrix[0, 0]), rays(both.first, matrix)
    rotation, angle = turn_between(first, rays(both.second, matrix))
    zoom, zoomed = _turn_and_zoom(first @ rotation.T, (both.second - matrix[:2, 2]) / np.diagonal(matrix)[:2])
    return focal * float(np.median(angle)), focal * zoomed, float(np.log(max(zoom, 1e-3)))


def _turn_and_zoom(expected: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Zoom that with a further turn maps directions (N, 3) to places (N, 2), and the median of what remains."""
    zoom, weight = 1.0, np.ones(len(seen))
    for _ in range(_ZOOM_STEPS):
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
