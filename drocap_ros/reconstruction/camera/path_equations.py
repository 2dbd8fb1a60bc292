"""Normal equations of a camera's path with its points eliminated: a band of the knots, bordered by the shared unknowns.

Gauss-Newton: second derivatives of the residuals are left out, and robust terms have the weight of the present point.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided

from drocap_ros.reconstruction.camera.path_model import KNOT, SHARED
from drocap_ros.reconstruction.camera.path_residuals import PathResiduals, gradient
from drocap_ros.reconstruction.common.banded import backward, band_factor, forward

#: Added to the weight of every point's unknowns, which are about radians: a point without parallax has any depth.  It
#: also holds the place of a path that nothing else holds, a little.
POINT_WEIGHT = 10.0
#: Couplings of the acceleration: two knots on.
_LEAST_REACH = 3


class Step(NamedTuple):
    """Changes of the knots (K, 6), the shared unknowns (SHARED,) and the points (J, 3)."""

    errors: np.ndarray
    shared: np.ndarray
    points: np.ndarray


class PathEquations:
    """The reduced equations at one point.

    band : (6 K, W), element [i, d] couples unknowns i and i + d; border : (6 K, SHARED); corner : (SHARED, SHARED)
    """

    def __init__(self, r: PathResiduals) -> None:
        self._residuals = r
        views, knots = r.data.views, r.data.knots
        before = knots.before[views.frame]
        self._first = before[views.begin] if len(views.track) else np.zeros(0, np.intp)
        reach = int((before - self._first[views.piece]).max(initial=0)) + 2
        self._reach = max(min(reach, knots.count), _LEAST_REACH)
        # Blocks of pieces near the end reach beyond the last knot; those rows are cut.
        self._rows = KNOT * (knots.count + self._reach)
        self._gradient = gradient(r)
        self._set_camera()
        self._add_time()
        self._eliminate(before)

    def _set_camera(self) -> None:
        """The part of the camera alone, summed over each frame and shared among the knots beside it."""
        r = self._residuals
        views, knots, frames = r.data.views, r.data.knots, r.data.path.frames
        camera = r.by_camera
        order, place = views.by_frame
        by_view = np.zeros((frames, int(place.max(initial=0)) + 1, 2, camera.shape[2]))
        by_view[views.frame[order], place] = camera[order]
        columns = by_view.reshape(frames, -1, camera.shape[2])
        own = np.swapaxes(columns, 1, 2) @ columns
        self.of_frame = own[:, :KNOT, :KNOT]
        self._free = r.weights.free
        self.corner = r.weights.shared + np.diag((~self._free).astype(float))
        self.corner[np.ix_(self._free, self._free)] += own[:, KNOT:, KNOT:].sum(axis=0)
        band = np.zeros((self._rows // KNOT, self._reach, KNOT, KNOT))
        self.border: np.ndarray = np.zeros((self._rows, SHARED))
        at, share = knots.before, knots.share
        for reach, first, weight in (
            (0, at, np.square(1.0 - share)),
            (0, at + 1, np.square(share)),
            (1, at, share * (1.0 - share)),
        ):
            np.add.at(band[:, reach], first, weight[:, None, None] * self.of_frame)
        by_knot = np.zeros((self._rows // KNOT, KNOT, int(self._free.sum())))
        np.add.at(by_knot, at, (1.0 - share)[:, None, None] * own[:, :KNOT, KNOT:])
        np.add.at(by_knot, at + 1, share[:, None, None] * own[:, :KNOT, KNOT:])
        self.border[:, self._free] = by_knot.reshape(self._rows, -1)
        width = KNOT * self._reach
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
        if count > 2:
            swing = weights.acceleration
            for offset, factor in ((0, 1.0), (1, 4.0), (2, 1.0)):
                band[offset : count - 2 + offset, :3, 0] += factor * swing
            band[: count - 2, :3, KNOT] -= 2 * swing
            band[1 : count - 1, :3, KNOT] -= 2 * swing
            band[: count - 2, :3, 2 * KNOT] += swing

    def _eliminate(self, before: np.ndarray) -> None:
        """Subtract what the points explain; pieces that begin at one knot have one dense block."""
        r = self._residuals
        views, knots = r.data.views, r.data.knots
        by_point, by_camera = r.by_point, r.by_camera
        own = by_point[:, 0, :, None] * by_point[:, 0, None] + by_point[:, 1, :, None] * by_point[:, 1, None]
        both = by_point[:, 0, :, None] * by_camera[:, 0, None] + by_point[:, 1, :, None] * by_camera[:, 1, None]
        inverse = np.linalg.inv(np.linalg.cholesky(views.of_pieces(own) + POINT_WEIGHT * np.eye(3)))
        coupling = np.zeros((len(views.track), 3, self._reach, KNOT))
        relative = before - self._first[views.piece]
        key = views.piece * self._reach + relative
        starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        piece, at = views.piece[starts], relative[starts]
        knot = both[..., :KNOT]
        later = knots.share[views.frame][:, None, None] * knot
        if len(starts) < len(key):
            knot, later = (np.add.reduceat(of_views, starts, axis=0) for of_views in (knot, later))
        coupling[piece, :, at] += knot - later
        coupling[piece, :, at + 1] += later
        self._inverse = inverse
        self._knots = inverse @ coupling.reshape(len(views.track), 3, -1)
        self._shared = inverse @ views.of_pieces(both[..., KNOT:])
        self._points = np.einsum("jik,jk->ji", inverse, self._gradient[2])
        self.right: np.ndarray = np.zeros(self._rows)
        self.right[: KNOT * knots.count] = self._gradient[0].reshape(-1)
        width, item = self.band.shape[1], self.band.itemsize
        square = np.zeros((width, 2 * width))
        # Element [i, d] is [i, i + d] of the square: the layout of the band.
        by_distance = as_strided(square, (width, width), ((2 * width + 1) * item, item), writeable=False)
        order = np.argsort(self._first, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(self._first[order])) + 1)
        for group in groups:
            row = KNOT * int(self._first[group[0]])
            rows = slice(row, row + width)
            block = self._knots[group].reshape(-1, width)
            square[:, :width] = block.T @ block
            self.band[rows] -= by_distance
            self.border[rows, self._free] -= block.T @ self._shared[group].reshape(len(block), self._shared.shape[2])
            self.right[rows] -= block.T @ self._points[group].reshape(-1)
        flat = self._shared.reshape(self._points.size, self._shared.shape[2])
        self.corner[np.ix_(self._free, self._free)] -= flat.T @ flat
        self.right_shared = self._gradient[1].copy()
        self.right_shared[self._free] -= flat.T @ self._points.reshape(-1)
        used = KNOT * knots.count
        self.band, self.border, self.right = self.band[:used], self.border[:used], self.right[:used]

    def step(self, damping: float = 0.0) -> Step | None:
        """The step; ``damping`` shortens it, a share of the knots' diagonal; None = not positive definite."""
        band = self.band.copy()
        band[:, 0] *= 1.0 + damping
        factor = band_factor(band)
        if factor is None:
            return None
        y = forward(factor, np.concatenate([-self.right[:, None], self.border], axis=1))
        corner = self.corner - y[:, 1:].T @ y[:, 1:]
        shared = np.linalg.solve(corner, -self.right_shared - y[:, 1:].T @ y[:, 0])
        knots = backward(factor, y[:, :1] - y[:, 1:] @ shared[:, None])[:, 0]
        reached = np.concatenate([knots, np.zeros(KNOT * self._reach)])
        near = reached[KNOT * self._first[:, None] + np.arange(self.band.shape[1])]
        inside = self._points + np.einsum("jik,jk->ji", self._knots, near) + self._shared @ shared[self._free]
        points = -np.einsum("jki,jk->ji", self._inverse, inside)
        errors = knots.reshape(-1, KNOT)
        return Step(errors, shared, points)
