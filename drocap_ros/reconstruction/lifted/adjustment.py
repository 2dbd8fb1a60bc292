"""Adjustment of the default method: poses of a window with constant bone lengths, by Gauss-Newton with line search.

The unknowns are the joints of all frames in camera axes, one length per bone, and the zoom: the person's relative
size in the image, 1 plus a piecewise linear function of time.  The cost is

- a robust (Geman-McClure) distance of the projected joints from the 2D joints, weighted joint by joint,
- the distance from the lifter's joints, weighted by its expected errors, robust in depth,
- the deviation of every bone from its length times the zoom, as in the paper's articulation term,
- the acceleration of the joints,
- the change of the zoom,
- the distance of the lengths from the expected ones.

Its normal equations couple neighbouring frames only: a band, bordered by the lengths and the zoom.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drocap_ros.geometry.alignment import pair_lengths
from drocap_ros.reconstruction.common.engine import (
    Equations,
    add_second_difference,
    descend,
    pull_second_difference,
    second_difference,
)
from drocap_ros.reconstruction.common.poses import CONVERGED, DEADLINE, ITERATIONS, NO_DESCENT
from drocap_ros.skeleton import BODY_17, RIGID_BONES, indices

_CHAIN = BODY_17.bones
#: Pairs of joints of (nearly) constant distance: the tree's bones, then the hips and the shoulders.
SPANS = np.concatenate(
    [_CHAIN, [indices(BODY_17.joints, ("rhip", "lhip")), indices(BODY_17.joints, ("lshoulder", "rshoulder"))]]
)
_RIGID = {tuple(indices(BODY_17.joints, pair)) for pair in RIGID_BONES} | {(0, 1), (0, 4)}
_FEET = {tuple(indices(BODY_17.joints, (side + "ankle", side + "toe"))) for side in "rl"}
#: Spread of each span's length on one person, mm: limbs are rigid, feet bend at the toes, trunk and shoulder girdle
#: are not rigid.
SPAN_STD_MM = np.array([4.0 if (p, c) in _RIGID else 6.0 if (p, c) in _FEET else 20.0 for p, c in _CHAIN] + [4.0, 25.0])

_SIZE = 3 * len(BODY_17)
#: Relative addition to the normal equations' diagonal.
_DAMPING = 1e-4
#: Error (mm) of a depth below which its term is quadratic, so that its curvature stays finite; a judgement.
DEPTH_ROUNDING_MM = 15.0


@dataclass(frozen=True)
class AdjustmentProblem:
    """A window in mm of an ordinary person.

    keypoints : (F, 17, 2); information : (F, 17, 3) 1/mm^2, xx, xy, yy of their inverse covariance, 0 where not seen
    prior : (F, 17, 3); prior_weight_xy : (F, 17) 1/mm^2; prior_weight_z : (F, 17) 1/mm
    acceleration_weight : 1/mm^2, of second differences
    zoom_basis : (F, K) value in each frame of the zoom's piecewise linear basis functions
    zoom_precision : (K, K) inverse covariance of their coefficients
    lengths : (18,) of :data:`SPANS`, expected; length_weight : 1/mm^2, of the distance from them
    outlier_square : squared residual, in standard deviations, at which a 2D joint has half its weight
    """

    keypoints: np.ndarray
    information: np.ndarray
    prior: np.ndarray
    prior_weight_xy: np.ndarray
    prior_weight_z: np.ndarray
    acceleration_weight: float
    zoom_basis: np.ndarray
    zoom_precision: np.ndarray
    lengths: np.ndarray
    length_weight: float = 0.0
    outlier_square: float = 9.0


@dataclass(frozen=True)
class AdjustmentSolution:
    """joints (F, 17, 3) mm, lengths (18,) mm of :data:`SPANS`, zoom (F,), cost per term, iterations, stop reason."""

    joints: np.ndarray
    lengths: np.ndarray
    zoom: np.ndarray
    cost_terms: dict[str, float]
    iterations: int
    stop_reason: str


def span_lengths(joints: np.ndarray) -> np.ndarray:
    """(..., 18) distances over :data:`SPANS` of joints (..., 17, D)."""
    return pair_lengths(joints, SPANS)


def zoom_model(frames: int, fps: float, std_per_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Basis (F, K) with a knot per second, and precision (K, K) of a random walk with a weak pull to zero."""
    knots = max(int(np.ceil((frames - 1) / fps)) + 1, 2)
    at = np.arange(frames) / fps
    basis = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
    step = np.diff(np.eye(knots), axis=0)
    return basis, step.T @ step / std_per_s**2 + np.eye(knots) / (10 * std_per_s) ** 2


class _Residuals:
    """Residuals at one point, shared by the cost and its derivatives."""

    def __init__(self, p: AdjustmentProblem, joints: np.ndarray, lengths: np.ndarray, zooms: np.ndarray) -> None:
        self.problem, self.joints, self.lengths, self.zooms = p, joints, lengths, zooms
        self.zoom = 1.0 + p.zoom_basis @ zooms
        self.zoom_pull = p.zoom_precision @ zooms
        self.growth = lengths - p.lengths
        self.image = joints[..., :2] - p.keypoints
        self.pull = np.stack(
            [
                p.information[..., 0] * self.image[..., 0] + p.information[..., 1] * self.image[..., 1],
                p.information[..., 1] * self.image[..., 0] + p.information[..., 2] * self.image[..., 1],
            ],
            axis=-1,
        )
        square = (self.image * self.pull).sum(axis=-1)
        self.robust = 1.0 / (1.0 + square / p.outlier_square)
        self.flat = joints[..., :2] - p.prior[..., :2]
        self.depth = joints[..., 2] - p.prior[..., 2]
        self.rounded = np.sqrt(np.square(self.depth) + DEPTH_ROUNDING_MM**2)
        span = joints[:, SPANS[:, 1]] - joints[:, SPANS[:, 0]]
        length = np.sqrt(np.square(span).sum(axis=-1) + 1e-6)
        self.direction = span / length[..., None]
        self.stretch = (length - self.zoom[:, None] * lengths) / SPAN_STD_MM
        self.swing = second_difference(joints)
        self.terms = {
            "reprojection": 0.5 * float((square * self.robust).sum()),
            "lifter_image": 0.5 * float((p.prior_weight_xy * np.square(self.flat).sum(axis=-1)).sum()),
            "lifter_depth": float((p.prior_weight_z * (self.rounded - DEPTH_ROUNDING_MM)).sum()),
            "articulation": 0.5 * float(np.square(self.stretch).sum()),
            "acceleration": 0.5 * p.acceleration_weight * float(np.square(self.swing).sum()),
            "zoom": 0.5 * float(zooms @ self.zoom_pull),
            "lengths": 0.5 * p.length_weight * float(np.square(self.growth).sum()),
        }
        self.cost = sum(self.terms.values())

    def moved(self, joints: np.ndarray, sizes: np.ndarray) -> _Residuals:
        """The point after a step of the joints (F, 17, 3), of the lengths and the zoom's coefficients (18 + K,)."""
        count = len(SPANS)
        return _Residuals(self.problem, self.joints + joints, self.lengths + sizes[:count], self.zooms + sizes[count:])

    def gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the cost by the same unknowns."""
        return _gradient(self.problem, self)


def _gradient(p: AdjustmentProblem, r: _Residuals) -> tuple[np.ndarray, np.ndarray]:
    g = np.zeros(p.prior.shape)
    g[..., :2] = np.square(r.robust)[..., None] * r.pull + p.prior_weight_xy[..., None] * r.flat
    g[..., 2] = p.prior_weight_z * r.depth / r.rounded
    pull = (r.stretch / SPAN_STD_MM)[..., None] * r.direction
    for k, (a, b) in enumerate(SPANS):
        g[:, b] += pull[:, k]
        g[:, a] -= pull[:, k]
    pull_second_difference(g, p.acceleration_weight * r.swing)
    by_length = p.length_weight * r.growth - (r.zoom[:, None] * r.stretch / SPAN_STD_MM).sum(axis=0)
    by_zoom = r.zoom_pull - p.zoom_basis.T @ (r.stretch @ (r.lengths / SPAN_STD_MM))
    return g, np.concatenate([by_length, by_zoom])


@lru_cache(maxsize=1)
def _band_places() -> tuple[np.ndarray, np.ndarray]:
    """(N,) places in a frame's rows of the band that spans fill, and (18 * 9, N) signs of their products there."""
    span, i, j, one, other = np.indices((len(SPANS), 3, 3, 2, 2)).reshape(5, -1)
    row, column = 3 * SPANS[span, one] + i, 3 * SPANS[span, other] + j
    kept = column >= row
    places, number = np.unique(row[kept] * (2 * _SIZE + 1) + (column - row)[kept], return_inverse=True)
    signs = np.zeros((9 * len(SPANS), len(places)), np.float32)
    np.add.at(signs, ((9 * span + 3 * i + j)[kept], number), np.where(one == other, 1.0, -1.0)[kept])
    return places, signs


def _band(p: AdjustmentProblem, r: _Residuals) -> np.ndarray:
    """Gauss-Newton matrix of the joints, (F * 51, 103) float32: element [i, d] couples unknowns i and i + d."""
    frames = len(p.prior)
    diagonal = np.zeros(p.prior.shape)
    seen = np.square(r.robust)[..., None] * p.information
    diagonal[..., :2] = seen[..., [0, 2]] + p.prior_weight_xy[..., None]
    diagonal[..., 2] = p.prior_weight_z / r.rounded
    pull = (r.direction / SPAN_STD_MM[:, None]).astype(np.float32)
    places, signs = _band_places()
    band = np.zeros((frames, _SIZE, 2 * _SIZE + 1), np.float32)
    band.reshape(frames, -1)[:, places] = (pull[..., :, None] * pull[..., None, :]).reshape(frames, -1) @ signs
    band[:, 0::3, 1] += seen[..., 1]
    band[:, :, 0] += diagonal.reshape(frames, _SIZE)
    add_second_difference(p.acceleration_weight, *(band[:, :, ahead * _SIZE] for ahead in range(3)))
    return band.reshape(frames * _SIZE, -1)


def _border(p: AdjustmentProblem, r: _Residuals) -> tuple[np.ndarray, np.ndarray]:
    """(F * 51, 18 + K) coupling of the joints with lengths and zoom, and (18 + K, 18 + K) of these with each other."""
    frames, knots = p.zoom_basis.shape
    count = len(SPANS)
    border = np.zeros((frames, len(BODY_17), 3, count + knots))
    by_size = np.zeros((frames, len(BODY_17), 3))
    slope = r.direction / np.square(SPAN_STD_MM)[:, None]
    for k, (a, b) in enumerate(SPANS):
        pull = r.zoom[:, None] * slope[:, k]
        border[:, b, :, k] = -pull
        border[:, a, :, k] = pull
        by_size[:, b] -= r.lengths[k] * slope[:, k]
        by_size[:, a] += r.lengths[k] * slope[:, k]
    border[..., count:] = by_size[..., None] * p.zoom_basis[:, None, None]
    precision = 1.0 / np.square(SPAN_STD_MM)
    corner = np.zeros((count + knots, count + knots))
    corner[:count, :count] = np.diag(precision * np.square(r.zoom).sum() + p.length_weight)
    # The product of the two unknowns bends the cost: its second derivative is left out, as in Gauss-Newton.
    corner[:count, count:] = (precision * r.lengths)[:, None] * (r.zoom @ p.zoom_basis)
    corner[count:, :count] = corner[:count, count:].T
    corner[count:, count:] = (precision * np.square(r.lengths)).sum() * p.zoom_basis.T @ p.zoom_basis + p.zoom_precision
    return border.reshape(-1, count + knots), corner


def adjust(
    problem: AdjustmentProblem,
    joints: np.ndarray,
    iterations: int,
    tolerance: float = 3e-3,
    cancelled: Callable[[], bool] | None = None,
) -> AdjustmentSolution:
    """Minimise the cost.

    joints : (F, 17, 3) mm, initial; the signs of depth stay as they are
    iterations : most accepted steps
    tolerance : relative decrease of the cost that ends the solve; on MoCap, poses err as with a third of it
    cancelled : called before every step but the first; True ends the solve with reason DEADLINE
    """
    stop = ITERATIONS
    here = _Residuals(problem, joints, problem.lengths, np.zeros(problem.zoom_basis.shape[1]))
    done = 0
    while done < iterations:
        if done and cancelled is not None and cancelled():
            stop = DEADLINE
            break
        there = _descend(problem, here)
        if there is None:
            stop = NO_DESCENT
            break
        decrease = here.cost - there.cost
        here = there
        done += 1
        if decrease <= tolerance * here.cost:
            stop = CONVERGED
            break
    return AdjustmentSolution(here.joints, here.lengths, here.zoom, here.terms, done, stop)


def _descend(p: AdjustmentProblem, here: _Residuals) -> _Residuals | None:
    """A lower point along the Gauss-Newton step, or None."""
    band, (border, corner) = _band(p, here), _border(p, here)
    band[:, 0] += _DAMPING * (band[:, 0] + 1e-2)
    corner += np.diag(_DAMPING * np.diag(corner))
    return descend(here, Equations(band, border, corner), here.moved)
