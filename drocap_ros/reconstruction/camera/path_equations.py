"""Normal equations of a camera's path with its points eliminated: a band of the knots, bordered by the shared unknowns.

Gauss-Newton: second derivatives of the residuals are left out, and robust terms have the weight of the present point.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided

from drocap_ros.reconstruction.camera.path_model import KNOT, SHARED
from drocap_ros.reconstruction.camera.path_residuals import PathResiduals, gradient, knots_of_frames
from drocap_ros.reconstruction.common.engine import Equations, add_second_difference

#: Added to the weight of every point's unknowns, which are about radians: a point without parallax has any depth.  It
#: also holds the place of a path that nothing else holds, a little.
POINT_WEIGHT = 10.0


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

    def step(self, damping: float = 0.0) -> Step | None:
        """The step; ``damping`` shortens it, a share of the knots' mean diagonal; None = not positive definite."""
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
        errors = knots.reshape(-1, KNOT)
        return Step(errors, shared, points)
