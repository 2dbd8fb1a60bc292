"""Cost of a camera's path at one point, its gradient, and the derivatives of the projected points.

The terms, each 0.5 times a weighted square, robust (Geman-McClure) for the points:

- the distance of a projected point from where it was seen,
- the errors of the path at the knots, which wander (Gauss-Markov),
- the acceleration of the corrected path,
- the priors of misalignment, latencies and focal length.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided

from drocap_ros.camera_path import CameraErrors
from drocap_ros.geometry.rotations import exp_so3, left_jacobian
from drocap_ros.reconstruction.camera.path_model import (
    ATTITUDE_LATENCY,
    FOCAL,
    KNOT,
    MISALIGNMENT,
    POSITION_LATENCY,
    SHARED,
    PathInput,
    PathState,
    tangents,
)
from drocap_ros.reconstruction.common.engine import (
    Equations,
    add_second_difference,
    pull_second_difference,
    second_difference,
    usual_outlier,
)

#: Squared residual, in standard deviations, at which a point has half its weight: three of them, as for joints.
OUTLIER_SQUARE = 9.0
#: Least depth of a point over its distance from the origin, in the path's unit.
_NEAREST = 1e-3


class PathWeights(NamedTuple):
    """Weights that do not depend on the unknowns.

    keep : (6,) share of an error that the next knot keeps; change, first : (6,) weights of its change and its value
    acceleration : of the second difference of the position at the knots
    shared : (SHARED, SHARED) inverse covariance of the priors; free : (SHARED,) bool, the others are held
    """

    keep: np.ndarray
    change: np.ndarray
    first: np.ndarray
    acceleration: float
    shared: np.ndarray
    free: np.ndarray


def weights_of(data: PathInput) -> PathWeights:
    """Weights from the expected errors."""
    config, step_s = data.config, data.knots.step_s
    errors = config.errors
    first = np.repeat([errors.position_wander_m, np.deg2rad(errors.attitude_wander_deg)], 3) ** -2.0
    keep = np.exp(-step_s / errors.wander_s)
    shared = expected_shared(errors, data.path.gimbal_axes(), config.focal)
    free = np.diag(shared) > 0.0
    if data.known is not None:
        shared = shared + np.where(free[:, None] & free, data.known, 0.0)
    fact = config.views_per_fact
    return PathWeights(
        keep=keep,
        change=fact * first / (1.0 - keep**2),
        first=fact * first,
        acceleration=fact * (errors.acceleration_m_s2 * step_s**2) ** -2.0,
        shared=fact * shared,
        free=free,
    )


def expected_shared(config: CameraErrors, axes: np.ndarray, focal: float = 0.0) -> np.ndarray:
    """(SHARED, SHARED) inverse covariance of the shared unknowns; rows and columns of held ones are zero.

    axes : (3, 3) of the gimbal, rows in camera axes; focal : deviation of the logarithm of the focal length
    """
    turned = np.deg2rad([config.tilt_deg, config.yaw_deg, config.tilt_deg])
    covariance = np.zeros((SHARED, SHARED))
    covariance[MISALIGNMENT, MISALIGNMENT] = axes.T @ np.diag(turned**2) @ axes
    latencies = slice(ATTITUDE_LATENCY, POSITION_LATENCY + 1)
    covariance[latencies, latencies] = config.latency_covariance
    covariance[FOCAL, FOCAL] = focal**2
    free, shared = np.zeros(SHARED, bool), np.zeros((SHARED, SHARED))
    free[MISALIGNMENT] = min(config.tilt_deg, config.yaw_deg) > 0.0
    free[latencies], free[FOCAL] = config.latency_s > 0.0, focal > 0.0
    inside = np.ix_(free, free)
    shared[inside] = np.linalg.inv(covariance[inside])
    return shared


class PathResiduals:
    """Residuals at one point.

    outlier : squared residual, in standard deviations, at which a point has half its weight
    """

    def __init__(self, data: PathInput, weights: PathWeights, state: PathState, outlier: float) -> None:
        self.data, self.weights, self.state, self.outlier = data, weights, state, outlier
        self._correct()
        self._compare_image()
        self._compare_path()
        self.cost = float(
            0.5 * (self.square * self.robust).sum()
            + 0.5 * (weights.first * np.square(state.errors[0])).sum()
            + 0.5 * (weights.change * np.square(self.change)).sum()
            + 0.5 * weights.acceleration * np.square(self.swing).sum()
            + 0.5 * state.shared @ weights.shared @ state.shared
        )

    def _correct(self) -> None:
        """The corrected path."""
        shared = self.state.shared
        path = self.data.path
        rotation, position = path.shifted(float(shared[ATTITUDE_LATENCY]), float(shared[POSITION_LATENCY]))
        self.errors = self.data.knots.at_frames(self.state.errors) + self.state.rest
        self.turn = shared[MISALIGNMENT] + self.errors[:, 3:]
        correction = exp_so3(self.turn)
        self.rotation = correction @ rotation
        self.turn_rate = np.einsum("fij,fj->fi", correction, path.turn_rate)
        self.position, self.velocity = position + self.errors[:, :3], path.velocity

    def _compare_image(self) -> None:
        """Projected points with the seen ones."""
        data, state, views = self.data, self.state, self.data.views
        self.focal = np.diagonal(data.matrix)[:2] * np.exp(state.shared[FOCAL])
        at = state.points[views.piece]
        offset = at[:, :3] - at[:, 3:] * (self.position / state.unit)[views.frame]
        self.seen = np.einsum("nij,nj->ni", self.rotation[views.frame], offset)
        self.depth = np.maximum(self.seen[:, 2], _NEAREST)
        self.slope = self.seen[:, :2] / self.depth[:, None]
        self.image = self.focal * self.slope + data.matrix[:2, 2] - views.point
        self.square = np.square(self.image).sum(axis=1) / data.config.noise_px**2
        self.robust = 1.0 / (1.0 + self.square / self.outlier)
        self._root = self.robust / data.config.noise_px

    def _compare_path(self) -> None:
        """Errors with those at the knot before, and the path with a steady flight."""
        errors, given = self.state.errors, self.data.path.position[self.data.knots.frame]
        self.change = errors[1:] - self.weights.keep * errors[:-1]
        flown = given + errors[:, :3]
        self.swing = second_difference(flown)

    def moved(self, errors: np.ndarray, shared: np.ndarray, points: np.ndarray) -> PathResiduals:
        """Residuals of the same cost after a step."""
        return PathResiduals(self.data, self.weights, self.state.moved(errors, shared, points), self.outlier)

    def with_outlier(self, outlier: float) -> PathResiduals:
        """Residuals at the same point with another square at which a point has half its weight."""
        return self if outlier == self.outlier else PathResiduals(self.data, self.weights, self.state, outlier)

    def usual_outlier(self) -> float:
        """Squared residual that sets outliers apart from the rest: far from the solution all are large."""
        return usual_outlier(self.square, OUTLIER_SQUARE)

    @cached_property
    def _by_place(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives (N, 2, 3) of the residuals by the places of points before the camera, and what they consist of.

        That is the slope (N, 2) of the rays, and the size (N, 2) of the residuals over a slope and a depth.
        """
        slope = np.where(self.seen[:, 2:] > _NEAREST, self.slope, 0.0)
        per_unit = (self._root / self.depth)[:, None] * self.focal
        rotation = self.rotation[self.data.views.frame]
        return per_unit[..., None] * (rotation[:, :2] - slope[..., None] * rotation[:, 2:]), slope, per_unit

    @cached_property
    def weighted(self) -> np.ndarray:
        """Residuals (N, 2) at the present robust weight."""
        return np.asarray(self._root[:, None] * self.image)

    @cached_property
    def by_point(self) -> np.ndarray:
        """Their derivatives (N, 2, 3) by the points."""
        state, views, (by_place, _, _) = self.state, self.data.views, self._by_place
        across = tangents(state.points)[views.piece]
        towards = -np.einsum("nki,ni->nk", by_place, (self.position / state.unit)[views.frame])
        return np.asarray(by_place @ across[:, :3] + towards[..., None] * across[:, 3][:, None])

    @cached_property
    def _by_turn(self) -> np.ndarray:
        """Derivatives (N, 2, 3) by a turn of the camera as it stands."""
        by_place, slope, per_unit = self._by_place
        out = np.empty(by_place.shape)
        x, y, z = self.seen.T
        out[:, 0, 0], out[:, 1, 0] = -slope[:, 0] * y, -z - slope[:, 1] * y
        out[:, 0, 1], out[:, 1, 1] = z + slope[:, 0] * x, slope[:, 1] * x
        out[:, 0, 2], out[:, 1, 2] = -y, x
        out *= per_unit[..., None]
        return out

    @property
    def by_errors(self) -> np.ndarray:
        """Derivatives (N, 2, KNOT) by a frame's error."""
        state, views = self.state, self.data.views
        out = np.empty((len(views.frame), 2, KNOT))
        out[..., :3] = self._by_place[0] * (-state.points[views.piece, 3] / state.unit)[:, None, None]
        out[..., 3:] = self._by_turn @ left_jacobian(self.turn)[views.frame]
        return out

    @cached_property
    def by_camera(self) -> np.ndarray:
        """Derivatives (N, 2, KNOT + U) by a frame's error and the U free shared unknowns."""
        frame, free = self.data.views.frame, np.flatnonzero(self.weights.free).tolist()
        out = np.empty((len(frame), 2, KNOT + len(free)))
        out[..., :KNOT] = self.by_errors
        for column, unknown in enumerate(free, KNOT):
            if unknown == ATTITUDE_LATENCY:
                out[..., column] = np.einsum("nki,ni->nk", self._by_turn, self.turn_rate[frame])
            elif unknown == POSITION_LATENCY:
                out[..., column] = np.einsum("nki,ni->nk", out[..., :3], self.velocity[frame])
            elif unknown == FOCAL:
                out[..., column] = self._root[:, None] * self.focal * self.slope
            else:
                out[..., column] = out[..., 3 + unknown]
        return out


def gradient(r: PathResiduals) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the cost by the knots' errors (K, 6), the shared unknowns (SHARED,) and the points (J, 3)."""
    data, state, weights = r.data, r.state, r.weights
    pull = np.einsum("nk,nki->ni", r.weighted, r.by_camera)
    of_frame = np.stack(
        [np.bincount(data.views.frame, pull[:, i], minlength=data.path.frames) for i in range(KNOT)], axis=1
    )
    errors = knots_of_frames(r, of_frame)
    errors[0] += weights.first * state.errors[0]
    drift = weights.change * r.change
    errors[1:] += drift
    errors[:-1] -= weights.keep * drift
    pull_second_difference(errors[:, :3], weights.acceleration * r.swing)
    shared = weights.shared @ state.shared
    shared[weights.free] += pull[:, KNOT:].sum(axis=0)
    return errors, shared, data.views.of_pieces(np.einsum("nk,nki->ni", r.weighted, r.by_point))


def knots_of_frames(r: PathResiduals, values: np.ndarray) -> np.ndarray:
    """Sums (K, ...) of values (F, ...) by the shares of the knots beside each frame."""
    knots = r.data.knots
    share = knots.share.reshape(-1, *(1,) * (values.ndim - 1))
    out = np.zeros((knots.count, *values.shape[1:]))
    np.add.at(out, knots.before, (1.0 - share) * values)
    np.add.at(out, knots.before + 1, share * values)
    return out


#: Added to the weight of every point's unknowns, which are about radians: a point without parallax has any depth.  It
#: also holds the place of a path that nothing else holds, a little.
POINT_WEIGHT = 10.0


class PathEquations:
    """The reduced equations at one point.

    band : (6 K, W), element [i, d] couples unknowns i and i + d; border : (6 K, SHARED); corner : (SHARED, SHARED)
    """

    def __init__(self, r: PathResiduals) -> None:
        self._residuals = r
        self._couplings = r.data.couplings
        # Blocks of pieces near the end reach beyond the last knot; those rows are cut.
        self._rows = KNOT * (r.data.knots.count + self._couplings.reach)
        self._gradient = gradient(r)
        self._set_camera()
        self._add_time()
        self._eliminate()

    def _set_camera(self) -> None:
        """The part of the camera alone, summed over each frame and shared among the knots beside it."""
        r = self._residuals
        knots = r.data.knots
        columns = r.data.views.of_frames(r.by_camera).reshape(r.data.path.frames, -1, r.by_camera.shape[2])
        own = np.swapaxes(columns, 1, 2) @ columns
        self.of_frame = own[:, :KNOT, :KNOT]
        self._free = r.weights.free
        self.corner = r.weights.shared + np.diag((~self._free).astype(float))
        self.corner[np.ix_(self._free, self._free)] += own[:, KNOT:, KNOT:].sum(axis=0)
        band = np.zeros((self._rows // KNOT, self._couplings.reach, KNOT, KNOT))
        self.border: np.ndarray = np.zeros((self._rows, SHARED))
        at, share = knots.before, knots.share
        for reach, first, weight in (
            (0, at, np.square(1.0 - share)),
            (0, at + 1, np.square(share)),
            (1, at, share * (1.0 - share)),
        ):
            np.add.at(band[:, reach], first, weight[:, None, None] * self.of_frame)
        by_knot = knots_of_frames(r, own[:, :KNOT, KNOT:])
        self.border[: KNOT * knots.count, self._free] = by_knot.reshape(KNOT * knots.count, -1)
        width = KNOT * self._couplings.reach
        self.band: np.ndarray = np.zeros((self._rows, width))
        row = np.arange(KNOT)
        for reach in (0, 1):
            for i in row:
                for j in row[i * (reach == 0) :]:
                    self.band[i::KNOT, reach * KNOT + j - i] = band[:, reach, i, j]

    def _add_time(self) -> None:
        """Wander of the errors and acceleration of the path."""
        weights, count = self._residuals.weights, self._residuals.data.knots.count
        band = self.band.reshape(-1, KNOT, self.band.shape[1])[:count]
        band[0, :, 0] += weights.first
        band[1:, :, 0] += weights.change
        band[:-1, :, 0] += weights.keep**2 * weights.change
        band[:-1, :, KNOT] -= weights.keep * weights.change
        add_second_difference(weights.acceleration, *(band[:, :3, ahead * KNOT] for ahead in range(3)))

    def _eliminate(self) -> None:
        """Subtract what the points explain; pieces that begin at one knot have one dense block."""
        r, first, order = self._residuals, self._couplings.first, self._couplings.order
        views = r.data.views
        across = np.swapaxes(r.by_point, 1, 2)
        own = views.of_pieces(across @ r.by_point) + POINT_WEIGHT * np.eye(3)
        self._inverse = np.linalg.inv(np.linalg.cholesky(own))
        both = self._inverse[views.piece] @ (across @ r.by_camera)
        knots = self._couplings.sums @ both[..., :KNOT].reshape(-1, KNOT)
        self._knots = knots.reshape(len(order), 3, -1)
        self._shared = views.of_pieces(both[..., KNOT:])[order]
        self._points = np.einsum("jik,jk->ji", self._inverse, self._gradient[2])[order]
        self.right: np.ndarray = np.zeros(self._rows)
        self.right[: self._gradient[0].size] = self._gradient[0].reshape(-1)
        columns = np.concatenate([self._shared, self._points[..., None], self._knots], axis=2)
        width, item = self.band.shape[1], self.band.itemsize
        others = columns.shape[2] - width
        product = np.zeros((width, others + 2 * width))
        # Element [i, d] is [i, i + d] of the square: the layout of the band.
        strides = (product.strides[0] + item, item)
        by_distance = as_strided(product[:, others:], (width, width), strides, writeable=False)
        starts = np.flatnonzero(np.diff(first, prepend=-1)).tolist()
        for begin, end in pairwise([*starts, len(first)]):
            rows = slice(KNOT * int(first[begin]), KNOT * int(first[begin]) + width)
            group = columns[begin:end].reshape(-1, columns.shape[2])
            product[:, : others + width] = group[:, others:].T @ group
            self.band[rows] -= by_distance
            self.border[rows, self._free] -= product[:, : others - 1]
            self.right[rows] -= product[:, others - 1]
        flat = columns[..., :others].reshape(-1, others)
        shared = flat[:, :-1].T @ flat
        self.corner[np.ix_(self._free, self._free)] -= shared[:, :-1]
        self.right_shared = self._gradient[1].copy()
        self.right_shared[self._free] -= shared[:, -1]
        used = self._gradient[0].size
        self.band, self.border, self.right = self.band[:used], self.border[:used], self.right[:used]

    def step(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Changes of the knots (K, 6), the shared unknowns (SHARED,) and the points (J, 3); None = not definite.

        damping : shortens the step, a share of the knots' mean diagonal
        """
        band = self.band.copy()
        # The mean over the axes does not depend on where north is.
        band[:, 0] += damping * np.repeat(band[:, 0].reshape(-1, 3).mean(axis=1), 3)
        found = Equations(band, self.border, self.corner).step(self.right, self.right_shared)
        if found is None:
            return None
        knots, shared = found
        reached = np.concatenate([knots, np.zeros(KNOT * self._couplings.reach)])
        near = reached[KNOT * self._couplings.first[:, None] + np.arange(self.band.shape[1])]
        inside = np.empty_like(self._points)
        inside[self._couplings.order] = (
            self._points + np.einsum("jik,jk->ji", self._knots, near) + self._shared @ shared[self._free]
        )
        points = -np.einsum("jki,jk->ji", self._inverse, inside)
        return knots.reshape(-1, KNOT), shared, points
