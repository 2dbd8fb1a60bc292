"""A camera's path from fixed points alone: a pair of keyframes, then one keyframe after the other, both ways."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drocap_ros.camera_path import CameraErrors
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.reconstruction.camera.kinds import Sightings, rays, turn_between, with_focal
from drocap_ros.reconstruction.camera.path_adjustment import AdjustedPath, adjust_path, improved_path
from drocap_ros.reconstruction.camera.path_model import FOCAL, PathConfig, PathInput, Views, triangulate
from drocap_ros.reconstruction.camera.upright import largest_plane
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry

#: Distance (px) of a point from its projection within which it agrees with a pose.
AGREES_PX = 4.0
#: Points that agree, at least.
LEAST_POINTS = 10


def resected(
    places: np.ndarray, pixels: np.ndarray, matrix: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation (3, 3) world -> camera and position (3,) that points (N, 3) at (N, 2) px agree with; None = none.

    Robust Gauss-Newton steps from the expected ``rotation`` and ``position``.
    """
    focal, before = np.diagonal(matrix)[:2], np.inf
    for _ in range(12):  # steps at most
        seen = (places - position) @ rotation.T
        x, y, z = seen.T
        # No point is nearer than a hundredth of the median depth.
        z = np.maximum(z, 0.01 * float(np.median(np.abs(z))) + 1e-12)
        slope = seen[:, :2] / z[:, None]
        rest = focal * slope + matrix[:2, 2] - pixels
        square = np.square(rest).sum(axis=1)
        usual = float(np.median(square))
        if abs(before - np.sqrt(usual)) < 0.01:  # px
            break
        before = float(np.sqrt(usual))
        # A point has half its weight at twice the median residual.
        weight = 1.0 / (1.0 + square / max(AGREES_PX**2, 4.0 * usual))
        # Rows of u and v: by the position, then by a turn in camera axes, as in ``path_residuals``.
        per_unit = (weight / z)[:, None] * focal
        rows = np.empty((len(places), 2, 6))
        rows[:, :, :3] = -per_unit[..., None] * (rotation[:2] - slope[..., None] * rotation[2])
        rows[:, 0, 3:] = np.stack([-slope[:, 0] * y, z + slope[:, 0] * x, -y], axis=1)
        rows[:, 1, 3:] = np.stack([-z - slope[:, 1] * y, slope[:, 1] * x, x], axis=1)
        rows[:, :, 3:] *= per_unit[..., None]
        flat = rows.reshape(-1, 6)
        normal = flat.T @ flat
        try:
            step = np.linalg.solve(normal, -flat.T @ (weight[:, None] * rest).reshape(-1))
        except np.linalg.LinAlgError:
            return None
        position, rotation = position + step[:3], exp_so3(step[3:]) @ rotation
    agree = (square < AGREES_PX**2) & (seen[:, 2] > 0.0)
    return (rotation, position) if agree.sum() >= max(LEAST_POINTS, 0.4 * len(places)) else None


#: Parallax (rad) above which more helps no pair, and from which a camera does not move little: six degrees.
ENOUGH_PARALLAX = 0.1


class Pair(NamedTuple):
    """Two keyframes, the parallax (rad) of the nearer points, and their worth as a beginning."""

    first: int
    second: int
    parallax: float
    score: float


def candidate_pairs(sightings: Sightings, matrix: np.ndarray, key_hz: float) -> list[Pair]:
    """Pairs with much parallax and many common points, best first."""
    found: list[Pair] = []
    for lag_s in (0.5, 1.0, 2.0, 3.0):  # between the keyframes of a pair
        lag = max(round(lag_s * key_hz), 1)
        if lag >= len(sightings):
            continue
        # At twelve places of a recording.
        for first in np.unique(np.linspace(0, len(sightings) - 1 - lag, 12).astype(int)).tolist():
            both = sightings.common(first, first + lag)
            if both.shape[1] < 16:
                continue
            _, angle = turn_between(both, matrix)
            # Far points have no parallax: the percentile is that of the nearer points.
            parallax = float(np.percentile(angle, 75))
            score = min(parallax, ENOUGH_PARALLAX) * float(np.sqrt(both.shape[1]))
            found.append(Pair(first, first + lag, parallax, score))
    found.sort(key=lambda pair: -pair.score)
    apart: list[Pair] = []
    for pair in found:
        if all(abs(pair.first - other.first) > key_hz for other in apart):
            apart.append(pair)
    return apart[:3]


#: Distance (px) of a point from its epipolar line or its projection within which it supports a camera.
_INLIER_PX = 2.0
#: Steps of an adjustment while the path grows, and of the last one.
LAST_STEPS = 12


@dataclass(frozen=True)
class Grown:
    """A path at keyframes: rotation (K, 3, 3) world -> camera, position (K, 3), known (K,) bool; matrix (3, 3) px.

    residual_px : median of the last adjustment; inf = none
    """

    rotation: np.ndarray
    position: np.ndarray
    known: np.ndarray
    matrix: np.ndarray
    residual_px: float = float("inf")


def begin(sightings: Sightings, pair: Pair, matrix: np.ndarray) -> Grown | None:
    """The path at a pair of keyframes, one unit of length apart, by the essential matrix; None = too few points fit."""
    import cv2

    plane = [np.ascontiguousarray(rays(points, matrix)) for points in sightings.common(pair.first, pair.second)]
    first, second = (direction[:, :2] / direction[:, 2:] for direction in plane)
    within = _INLIER_PX / float(matrix[0, 0])
    essential, inside = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, within, 1000)
    if essential is None or essential.shape != (3, 3):
        return None
    count, turn, shift, _ = cv2.recoverPose(essential, first, second, np.eye(3), mask=inside)
    if count < LEAST_POINTS:
        return None
    keys = len(sightings)
    rotation, position, known = np.tile(np.eye(3), (keys, 1, 1)), np.zeros((keys, 3)), np.zeros(keys, bool)
    rotation[pair.second], position[pair.second] = turn, -turn.T @ shift[:, 0]
    known[[pair.first, pair.second]] = True
    return Grown(rotation, position, known, matrix)


class Growth:
    """A path that grows: every known keyframe adds to the points, which place the next one."""

    def __init__(self, sightings: Sightings, start: Grown, key_hz: float, focal_std: float) -> None:
        self.sightings, self.path, self.key_hz, self.focal_std = sightings, start, key_hz, focal_std
        self._gather()

    def grow(self, most: int) -> Grown:
        """Place keyframes on both sides until ``most`` are known or no more can be placed; adjust now and then."""
        # Keyframes at the first adjustment, then their growth until the next one.
        due = 12
        while int(self.path.known.sum()) < most and self.extend():
            if self.path.known.sum() >= due:
                self.adjust()
                due = int(1.6 * self.path.known.sum())
        if self.path.known.sum() > 2:
            self.adjust()
        return self.path

    def extend(self) -> bool:
        """Place the next keyframes by the points of the known ones; whether any could be placed."""
        return any(place() for place in self._ways())

    def _by_points(self) -> bool:
        """Place the next keyframes by points whose depth is known; whether any could be placed."""
        placed = [self._place(key) for key in self._next_keys()]
        return any(placed)

    @property
    def _flat(self) -> np.ndarray:
        """(J,) points whose rays show no depth."""
        # Below 2 degrees (rad) a point's depth is the noise's, of tracks that err by 0.05.
        return np.asarray(np.linalg.norm(self._ray - self._first, axis=1) < 0.035)

    def _ways(self) -> tuple[Callable[[], bool], Callable[[], bool]]:
        """Ways to place the next keyframes, the better one first.

        Where a camera hovers, most points that would place them have no depth: each place would lean on the last one's.
        """
        flat = self._flat
        seen = [flat[piece[usable]] for usable, piece, _ in map(self._matches, self._next_keys())]
        hovers = sum(int(of.sum()) for of in seen) > 0.5 * sum(map(len, seen))
        return (self._on_ground, self._by_points) if hovers else (self._by_points, self._on_ground)

    def _on_ground(self) -> bool:
        """Place the next keyframes by points that are taken to lie on the ground; whether any could be placed.

        A camera that hovers sees points without depth, and a path ends there; most of what it sees is ground.
        """
        known, flat = self.path.known, self._flat
        up = -self.path.rotation[known, 1].mean(axis=0)
        # The usual image's horizontal may lean against the ground by 60 degrees.
        ground = largest_plane(self.places[self.usable & ~flat], self.path.position[known], up, 60.0)
        if ground is None:
            return False
        normal, level = ground
        height, falls = self._eye @ normal - level, -self._ray @ normal
        # Ground counts up to 20 heights of the camera away.
        lying = (self._count > 0) & flat & (height > 0.0) & (falls > 1.0 / 20.0)
        away = (height[lying] / falls[lying])[:, None]
        # Rays from one place meet there: other points without depth would hold the camera fast.
        self.places[lying], self.usable[flat] = self._eye[lying] + away * self._ray[lying], lying[flat]
        return self._by_points()

    def _next_keys(self) -> list[int]:
        """Keyframes to try: those inside a pair first, then the next ones outside, or beyond a gap."""
        known = np.flatnonzero(self.path.known)
        low, high = int(known[0]), int(known[-1])
        inside = [key for key in range(low, high) if not self.path.known[key]]
        if len(known) == 2 and inside:
            return inside
        # Keyframes behind a gap may be passed over while a camera sees too little.
        for gap in range(1, 8 + 1):
            keys = [key for key in (low - gap, high + gap) if 0 <= key < len(self.sightings)]
            if any(self._matches(key)[0].sum() >= LEAST_POINTS for key in keys):
                return keys
        return []

    def _matches(self, key: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        piece, point = self.sightings.at(key)
        usable = self.usable[piece]
        return usable, piece, point

    def _place(self, key: int) -> bool:
        """Place a keyframe by the points it sees; whether enough of them agree."""
        usable, piece, point = self._matches(key)
        if usable.sum() < LEAST_POINTS:
            return False
        found = resected(self.places[piece[usable]], point[usable], self.path.matrix, *self._predicted(key))
        if found is None:
            return False
        self.path.rotation[key], self.path.position[key] = found
        self.path.known[key] = True
        self._add(key)
        self._solve(piece)
        return True

    def _predicted(self, key: int) -> tuple[np.ndarray, np.ndarray]:
        """The nearest known keyframe's pose, turned by the common points and moved on as before."""
        known = np.flatnonzero(self.path.known)
        near = int(known[np.argmin(np.abs(known - key))])
        both = self.sightings.common(near, key)
        rotation = self.path.rotation[near]
        if both.shape[1] >= LEAST_POINTS:
            rotation = turn_between(both, self.path.matrix)[0] @ rotation
        other = 2 * near - key
        steady = 0 <= other < len(self.path.known) and bool(self.path.known[other])
        step = self.path.position[near] - self.path.position[other] if steady else 0.0
        return rotation, self.path.position[near] + step

    def _gather(self) -> None:
        """The points of all known keyframes anew."""
        pieces = len(self.sightings.views.track)
        self._square, self._count = np.zeros((pieces, 4, 4)), np.zeros(pieces, int)
        self.places, self.usable = np.zeros((pieces, 3)), np.zeros(pieces, bool)
        #: Those of the usable ones that are behind the camera that sees them.
        self._behind = np.zeros(pieces, bool)
        #: Where each point was last seen from, the direction there, and the first one.
        self._eye, self._ray, self._first = np.zeros((3, pieces, 3))
        for key in np.flatnonzero(self.path.known).tolist():
            self._add(key)
        self._solve(np.arange(pieces))

    def _add(self, key: int) -> None:
        piece, point = self.sightings.at(key)
        plane = (point - self.path.matrix[:2, 2]) / np.diagonal(self.path.matrix)[:2]
        rotation, position = self.path.rotation[key], self.path.position[key]
        camera = np.concatenate([rotation, -(rotation @ position)[:, None]], axis=1)
        rows = camera[:2] - plane[..., None] * camera[2]
        self._square[piece] += np.swapaxes(rows, 1, 2) @ rows
        self._eye[piece], self._ray[piece] = position, rays(point, self.path.matrix) @ rotation
        new = piece[self._count[piece] == 0]
        self._first[new] = self._ray[new]
        self._count[piece] += 1

    def _solve(self, piece: np.ndarray) -> None:
        """Points of pieces, and whether they are usable: seen twice, with a depth that the rays agree on."""
        value, vector = np.linalg.eigh(self._square[piece])
        point = vector[..., 0] * np.sign(vector[:, 3, :1])
        known = np.flatnonzero(self.path.known)
        way = max(float(np.linalg.norm(np.ptp(self.path.position[known], axis=0))), 1e-9)
        self.places[piece] = point[:, :3] / np.maximum(point[:, 3:], 1e-12)
        # The least square is that of a good point's residuals; the next one tells how well its depth is known.
        noise = np.square(_INLIER_PX / self.path.matrix[0, 0]) * np.square(np.linalg.norm(point, axis=1))
        agree = value[:, 0] < self._count[piece] * np.maximum(noise * np.square(way), 1e-30) * 100.0
        # A point this much farther than the camera's way places no camera.
        near = np.linalg.norm(self.places[piece], axis=1) < 200.0 * way
        deep = value[:, 1] > 30.0 * np.maximum(value[:, 0], 1e-30)
        sure = (self._count[piece] >= 2) & agree & near & deep
        before = np.einsum("ni,ni->n", self.places[piece] - self._eye[piece], self._ray[piece]) > 0.0
        self.usable[piece], self._behind[piece] = sure, sure & ~before

    @property
    def behind(self) -> float:
        """Share of the points that are behind the camera, as in a path that is turned inside out."""
        return float(self._behind.sum() / max(int(self.usable.sum()), 1))

    def adjust(self) -> None:
        """Adjust what is known, at the keyframes alone, and take it over."""
        known = np.flatnonzero(self.path.known)
        keys = np.arange(len(self.sightings))
        data = _problem(self.sightings.at_keys, keys, self.path, self.key_hz, self.focal_std)
        if data is None:
            return
        # Few steps will do while the path grows.
        found, _, _ = improved_path(replace(data, config=replace(data.config, iterations=5)))
        rotation, position = self.path.rotation.copy(), self.path.position.copy()
        rotation[known], position[known] = found.rotation[known - known[0]], found.position[known - known[0]]
        matrix = with_focal(self.path.matrix, float(np.exp(found.state.shared[FOCAL])))
        # The way is the unit: what an adjustment shrinks grows back.
        scale = max(float(np.linalg.norm(np.ptp(position[known], axis=0))), 1e-9)
        residual_px = float(np.median(np.linalg.norm(found.image, axis=1)))
        self.path = Grown(rotation, position / scale, self.path.known, matrix, residual_px)
        self._gather()


def with_ends(sightings: Sightings, path: Grown) -> Grown:
    """The path with the keyframes before and behind the known ones: turned as the points say, at the nearest place.

    Points that a hovering camera sees have no depth and place nothing; an adjustment finds the little that it moves.
    """
    known = np.flatnonzero(path.known)
    rotation, position, filled = path.rotation.copy(), path.position.copy(), path.known.copy()
    ends = [(key, key + 1) for key in range(int(known[0]) - 1, -1, -1)]
    ends += [(key, key - 1) for key in range(int(known[-1]) + 1, len(sightings))]
    for key, near in ends:
        rotation[key] = _turned(sightings, near, key, path.matrix) @ rotation[near]
        position[key], filled[key] = position[near], True
    return replace(path, rotation=rotation, position=position, known=filled)


def _turned(sightings: Sightings, first: int, second: int, matrix: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) from one keyframe to another by their common points; none where there are too few."""
    both = sightings.common(first, second)
    return np.eye(3) if both.shape[1] < 3 else turn_between(both, matrix)[0]


def turns(sightings: Sightings, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (F, 3, 3) from keyframe to keyframe, as if the camera kept its place, and zero positions (F, 3)."""
    rotation = np.tile(np.eye(3), (len(sightings), 1, 1))
    for key in range(1, len(sightings)):
        rotation[key] = _turned(sightings, key - 1, key, matrix) @ rotation[key - 1]
    return between(sightings.frames, rotation, np.zeros((len(sightings), 3)))


def small_motion(
    sightings: Sightings, matrix: np.ndarray, fps: float, focal_std: float, horizon: float
) -> AdjustedPath | None:
    """The path of a camera that moves little beside the points' distances, from turns alone.

    Source: Yu, Gallup 2014 (3D reconstruction from accidental motion): such a bundle adjustment needs no motion to
    begin with, only depths that are about right.
    """
    path = CameraTelemetry(*turns(sightings, matrix), fps)
    # An acceleration of 0.3 heights of the camera per s^2: it moves little.
    config = replace(free_config(1.0, focal_std, 0.3), iterations=25)
    return adjust_path(PathInput(path, matrix, sightings.views, config), horizon=horizon)


def free_config(unit: float, focal_std: float, acceleration: float | None = None) -> PathConfig:
    """Priors of a path that nothing but its points holds.

    unit : usual distance of points, in the path's unit, and its usual acceleration, where that is not given
    """
    position_wander, acceleration = 10.0 * unit, unit if acceleration is None else acceleration
    return PathConfig(
        CameraErrors(0.0, 0.0, 0.0, position_wander, attitude_wander_deg=60.0, acceleration_m_s2=acceleration),
        focal=focal_std,
        jitter_m=1e-3 * unit,
        jitter_deg=1.0,
    )


def adjusted(sightings: Sightings, path: Grown, fps: float, focal_std: float, iterations: int) -> AdjustedPath | None:
    """The core's adjustment of a grown path, over the frames from its first known keyframe to the last one."""
    data = _problem(sightings.views, sightings.frames, path, fps, focal_std)
    return None if data is None else adjust_path(replace(data, config=replace(data.config, iterations=iterations)))


def _problem(views: Views, keys: np.ndarray, path: Grown, fps: float, focal_std: float) -> PathInput | None:
    """The adjustment of a grown path, whose keyframes are the frames ``keys`` (K,) of the views; None = no points."""
    known = np.flatnonzero(path.known)
    begin_at, end = int(keys[known[0]]), int(keys[known[-1]]) + 1
    rotation, position = between(keys[known] - begin_at, path.rotation[known], path.position[known])
    inside = (views.frame >= begin_at) & (views.frame < end)
    enough = np.bincount(views.piece[inside], minlength=len(views.track)) >= 3
    inside &= enough[views.piece]
    number = np.cumsum(enough) - 1
    part = Views(
        views.frame[inside] - begin_at,
        number[views.piece[inside]],
        views.point[inside],
        views.track[enough],
        end - begin_at,
    )
    if not len(part.frame):
        return None
    way = max(float(np.linalg.norm(np.ptp(position, axis=0))), 1e-9)
    points = triangulate(part, rotation, position / way, path.matrix)
    unit = way * float(np.median(np.linalg.norm(points[:, :3], axis=1) / np.maximum(np.abs(points[:, 3]), 1e-3)))
    return PathInput(CameraTelemetry(rotation, position, fps), path.matrix, part, free_config(unit, focal_std))


def between(frames: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses at all frames from those at some (N,), from 0 to the last one: splines of both."""
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    at = np.arange(int(frames[-1]) + 1)
    if len(frames) < 3:
        share = (at / max(at[-1], 1))[:, None]
        turn = log_so3(rotation[-1] @ rotation[0].T)
        return exp_so3(share * turn) @ rotation[0], (1.0 - share) * position[0] + share * position[-1]
    turned = RotationSpline(frames, Rotation.from_matrix(rotation))(at).as_matrix()
    return np.asarray(turned), np.asarray(CubicSpline(frames, position)(at))
