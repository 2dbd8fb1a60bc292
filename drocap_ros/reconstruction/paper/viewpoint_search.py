"""Search of viewpoint and pose with a dense, few-parameter model of the dictionary's poses.

Each frame is fitted from several viewpoints around the body by damped Gauss-Newton steps over rotation,
translation, scale and the coefficients of the principal components, all frames and viewpoints in one batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.common.config import InitializerConfig
from drocap_ros.reconstruction.paper.dictionary import Dictionary, soft_threshold
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first
from drocap_ros.reconstruction.paper.rotations import update_rotations
from drocap_ros.skeleton import BODY_15


@dataclass(frozen=True)
class SparseFit:
    """Poses as sparse combinations.

    coefficients : (F, 1 + K); the first is that of the mean pose
    rotation : (F, 3, 3) torso -> camera
    shape : (F, P, 3) torso frame, in the unit of the 2D joints
    """

    coefficients: np.ndarray
    rotation: np.ndarray
    shape: np.ndarray

    @property
    def camera_shape(self) -> np.ndarray:
        """(F, P, 3) poses in camera axes."""
        turned: np.ndarray = self.shape @ np.swapaxes(self.rotation, 1, 2)
        return turned


def fit_sparse(
    projection: Projection,
    rotation: np.ndarray,
    coefficients: np.ndarray,
    dictionary: Dictionary,
    config: InitializerConfig,
) -> SparseFit:
    """Refine initial poses over one block of frames.

    rotation, coefficients : (F, 3, 3), (F, 1 + K) initial values
    """
    basis = dictionary.basis
    penalty = np.full((len(basis), 1), config.sparsity)
    penalty[0] = 0.0
    curvature = dictionary.curvature * float(projection.information[[0, 2]].max())
    step = 1.0 / (curvature + 4.0 * config.coefficient_smoothness)
    c, r = np.ascontiguousarray(coefficients.T), np.ascontiguousarray(np.moveaxis(rotation, 0, -1))
    for _ in range(config.sparse_rounds):
        ahead, t = c, 1.0
        for _ in range(config.sparse_iterations):
            gradient = sparse_gradient(projection, r, ahead, basis, config.coefficient_smoothness)
            new = soft_threshold(ahead - step * gradient, step * penalty)
            t_new = 0.5 * (1.0 + float(np.sqrt(1.0 + 4.0 * t * t)))
            move = new - c
            # Gradient restart (O'Donoghue and Candes 2015): the momentum must not point uphill.
            if np.vdot(ahead - new, move) > 0.0:
                ahead, t_new = new, 1.0
            else:
                ahead = new + ((t - 1.0) / t_new) * move
            c, t = new, t_new
        r = update_rotations(projection, _shapes(basis, c), r, steps=2, smoothness=config.rotation_smoothness)
    return SparseFit(c.T, np.ascontiguousarray(np.moveaxis(r, -1, 0)), frames_first(_shapes(basis, c)))


def sparse_gradient(
    projection: Projection, r: np.ndarray, c: np.ndarray, basis: np.ndarray, smoothness: float
) -> np.ndarray:
    """(1 + K, F) gradient of the smooth part by the coefficients (1 + K, F), for rotations (3, 3, F)."""
    _, slope = projection.value_and_gradient(_shapes(basis, c), r)
    gradient: np.ndarray = 0.5 * (basis @ slope.reshape(basis.shape[1], -1))
    if smoothness > 0.0:
        change = smoothness * (c[:, 1:] - c[:, :-1])
        gradient[:, 1:] += change
        gradient[:, :-1] -= change
    return gradient


def _shapes(basis: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(3, P, F) shapes of coefficients (1 + K, F)."""
    shapes: np.ndarray = (basis.T @ c).reshape(3, -1, c.shape[1])
    return shapes


#: Poses fitted in one batch: their Jacobians fit the processor's cache.
CHUNK = 256


@dataclass(frozen=True)
class DenseFit:
    """Fits of N poses, in the unit of the 2D joints.

    rotation : (N, 3, 3) torso -> camera
    coefficients : (N, 1 + D): of the mean pose (the body's image scale) and of the components
    translation : (N, 2)
    camera_shape : (N, P, 3) poses in camera axes
    cost : (N,) negative log posterior up to a constant, times 2
    """

    rotation: np.ndarray
    coefficients: np.ndarray
    translation: np.ndarray
    camera_shape: np.ndarray
    cost: np.ndarray


def initial_viewpoints(w: np.ndarray, information: np.ndarray, azimuths: int, elevation_rad: float) -> np.ndarray:
    """(A, F, 3, 3) torso -> camera: viewpoints around the body, rolled to the direction of the trunk in the image."""
    up = w[:, BODY_15.index("neck")] - w[:, BODY_15.index("pelvis")]
    seen = (information[:, [BODY_15.index("neck"), BODY_15.index("pelvis")], 0] > 0.0).all(1)
    roll = np.where(seen, np.arctan2(up[:, 0], -up[:, 1]), 0.0)
    zero = np.zeros_like(roll)
    rolled = exp_so3(np.stack([zero, zero, roll], axis=-1))
    angle = 2.0 * np.pi * np.arange(azimuths) / azimuths
    ce, se = np.cos(elevation_rad), np.sin(elevation_rad)
    forward = -np.stack([np.cos(angle) * ce, np.sin(angle) * ce, np.full(azimuths, se)], axis=-1)
    right = np.stack([-np.sin(angle), np.cos(angle), np.zeros(azimuths)], axis=-1)
    upright = np.stack([right, np.cross(forward, right), forward], axis=1)
    views: np.ndarray = rolled @ upright[:, None]
    return views


def image_scale(w: np.ndarray, information: np.ndarray, dictionary: Dictionary) -> float:
    """2D units per metre of the dictionary, from the extent of the joints in the image, robust over the frames."""
    weight = information[..., 0]
    count = np.sum(weight > 0.0, axis=1)
    full: np.ndarray = count >= min(int(0.7 * w.shape[1]), int(count.max()))
    share = weight[full] / weight[full].sum(1, keepdims=True)
    mean = np.sum(share[..., None] * w[full], axis=1, keepdims=True)
    spread = np.sum(share[..., None] * (w[full] - mean) ** 2, axis=(1, 2))
    expected = np.sum(dictionary.mean[:, 1:] ** 2) / len(dictionary.mean)
    return float(np.sqrt(np.percentile(spread, 75) / expected))


def search_viewpoints(
    w: np.ndarray, information: np.ndarray, dictionary: Dictionary, config: InitializerConfig
) -> DenseFit:
    """Fits from every initial viewpoint, with a leading axis of viewpoints: (A, F, ...).

    w, information : (F, P, 2), (F, P, 3)
    """
    views = initial_viewpoints(w, information, config.search_azimuths, np.deg2rad(config.search_elevation_deg))
    count, frames = views.shape[:2]
    search = _Search(np.tile(w, (count, 1, 1)), np.tile(information, (count, 1, 1)), dictionary, config)
    rotation = views.reshape(-1, 3, 3)
    coefficients = np.zeros((len(rotation), 1 + min(config.search_components, len(dictionary.components))))
    half = config.search_iterations // 2
    scale = image_scale(w, information, dictionary)
    coefficients[:, 0] = scale
    # The scale is common to the sequence: fit it loosely first, then hold the frames to their median.
    # Spread of the scale in the first half of the steps, over the configured one; chosen by hand.
    loose = search.fit(rotation, coefficients, scale, 3.0 * config.scale_std, half)
    best = np.argmin(loose.cost.reshape(count, frames), axis=0)
    scale = float(np.median(loose.coefficients.reshape(count, frames, -1)[best, np.arange(frames), 0]))
    fit = search.fit(loose.rotation, loose.coefficients, scale, config.scale_std, config.search_iterations - half)
    return DenseFit(*(value.reshape(count, frames, *value.shape[1:]) for value in vars(fit).values()))


@dataclass(frozen=True)
class _Search:
    """2D joints (N, P, 2) and their information (N, P, 3), one row per pose and viewpoint."""

    w: np.ndarray
    information: np.ndarray
    dictionary: Dictionary
    config: InitializerConfig

    def fit(
        self, rotation: np.ndarray, coefficients: np.ndarray, scale: float, scale_std: float, iterations: int
    ) -> DenseFit:
        """Damped Gauss-Newton steps from initial values (N, 3, 3), (N, 1 + D).

        scale, scale_std : expected coefficient of the mean pose and its relative spread
        """
        parts = [
            _descend(_Problem(self, rows, scale, scale_std), rotation[rows], coefficients[rows], iterations)
            for rows in (slice(first, first + CHUNK) for first in range(0, len(self.w), CHUNK))
        ]
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        return DenseFit(*(np.concatenate(values) for values in columns))


def _descend(problem: _Problem, rotation: np.ndarray, coefficients: np.ndarray, iterations: int) -> DenseFit:
    state = problem.evaluate(rotation, coefficients, np.zeros((len(rotation), 2)))
    damping: np.ndarray = np.full(len(rotation), 1e-2)
    for _ in range(iterations):
        trial = problem.step(state, damping)
        better = trial.cost < state.cost
        damping = np.where(better, np.maximum(0.2 * damping, 1e-6), np.minimum(5.0 * damping, 1e6))
        state = DenseFit(
            *(
                np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(vars(trial).values(), vars(state).values(), strict=True)
            )
        )
    return state


class _Problem:
    """Cost, Jacobian and step for a batch; unknowns are rotation 3, translation 2, coefficients 1 + D."""

    def __init__(self, search: _Search, rows: slice, scale: float, scale_std: float) -> None:
        w, information, dictionary, config = search.w[rows], search.information[rows], search.dictionary, search.config
        size = min(config.search_components, len(dictionary.components))
        basis = np.concatenate([dictionary.mean[None], dictionary.components[:size]])
        self.w = w
        self.shapes = basis.reshape(len(basis), -1)
        self.columns = np.ascontiguousarray(basis.transpose(2, 1, 0)).reshape(3, -1)
        self.prior_mean = np.concatenate([[scale], np.zeros(size)])
        self.prior = np.concatenate(
            [[1.0 / (scale_std * scale)], 1.0 / (scale * np.maximum(dictionary.component_std[:size], 1e-4))]
        )
        # Square root U of the information, U^T U = information, so that |U r|^2 is the cost of a residual.
        xx, xy, yy = (information[..., i] / config.keypoint_std**2 for i in range(3))
        a = np.sqrt(np.maximum(xx, 0.0))
        b = xy / np.where(a > 0.0, a, 1.0)
        self.root = np.stack([a, b, np.sqrt(np.maximum(yy - b * b, 0.0))], axis=-1)

    def whiten(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a, b, c = (self.root[..., i].reshape(*self.root.shape[:2], *[1] * (x.ndim - 2)) for i in range(3))
        return a * x + b * y, c * y

    def residual(self, x: np.ndarray, translation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gap = x[..., :2] + translation[:, None] - self.w
        return self.whiten(gap[..., 0], gap[..., 1])

    def evaluate(self, rotation: np.ndarray, coefficients: np.ndarray, translation: np.ndarray) -> DenseFit:
        x = (coefficients @ self.shapes).reshape(len(coefficients), -1, 3) @ np.swapaxes(rotation, 1, 2)
        rx, ry = self.residual(x, translation)
        cost = (rx * rx + ry * ry).sum(1) + np.sum(((coefficients - self.prior_mean) * self.prior) ** 2, axis=1)
        return DenseFit(rotation, coefficients, translation, x, cost)

    def step(self, state: DenseFit, damping: np.ndarray) -> DenseFit:
        n, p = self.w.shape[:2]
        x = state.camera_shape
        j = np.zeros((2, n, p, 5 + len(self.prior)))
        j[0, ..., 1], j[0, ..., 2], j[0, ..., 3] = x[..., 2], -x[..., 1], 1.0
        j[1, ..., 0], j[1, ..., 2], j[1, ..., 4] = -x[..., 2], x[..., 0], 1.0
        for row in range(2):
            j[row, ..., 5:] = (state.rotation[:, row] @ self.columns).reshape(n, p, -1)
        rx, ry = self.residual(x, state.translation)
        jx, jy = self.whiten(j[0], j[1])
        jac = np.concatenate([jx, jy], axis=1)
        transposed = np.ascontiguousarray(np.swapaxes(jac, 1, 2))
        a = transposed @ jac
        b = -(transposed @ np.concatenate([rx, ry], axis=1)[..., None])[..., 0]
        b[:, 5:] -= self.prior**2 * (state.coefficients - self.prior_mean)
        diagonal = np.arange(a.shape[1])
        a[:, diagonal[5:], diagonal[5:]] += self.prior**2
        a[:, diagonal, diagonal] *= (1.0 + damping)[:, None]
        a[:, diagonal, diagonal] += 1e-6
        d = np.linalg.solve(a, b[..., None])[..., 0]
        return self.evaluate(
            exp_so3(d[:, :3]) @ state.rotation, state.coefficients + d[:, 5:], state.translation + d[:, 3:5]
        )
