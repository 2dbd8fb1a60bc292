"""Adjustment of a camera's path by fixed points: steps of Gauss-Newton, then the rest of each frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import hat
from drocap_ros.reconstruction.camera.path_model import (
    ATTITUDE_LATENCY,
    KNOT,
    MISALIGNMENT,
    POSITION_LATENCY,
    SHARED,
    PathInput,
    PathState,
    Views,
    triangulate,
)
from drocap_ros.reconstruction.camera.path_residuals import (
    OUTLIER_SQUARE,
    POINT_WEIGHT,
    PathEquations,
    PathResiduals,
    weights_of,
)
from drocap_ros.reconstruction.common.engine import Covariances, Equations
from drocap_ros.reconstruction.common.poses import CONVERGED, ITERATIONS, NO_DESCENT
from drocap_ros.reconstruction.world.world_model import Findings


class Posterior(NamedTuple):
    """Covariances of K knots, position (m) and rotation (rad, camera axes).

    shared : (SHARED, SHARED) of the shared unknowns
    knots : (K, 6, 6) of the errors
    steps : (K - 1, 6, 6) of the change of the errors from knot to knot
    place : (3, 3) of the mean position of the path: what all its frames have in common, as points never tell it
    pose : (K, 6, 6) of the corrected camera: errors and shared unknowns, about that place and with it
    shape : (K, 2) standard deviations of position and rotation after the best similarity, of a path without telemetry
    """

    shared: np.ndarray
    knots: np.ndarray
    steps: np.ndarray
    place: np.ndarray
    pose: np.ndarray
    shape: np.ndarray | None


def posterior_of(r: PathResiduals) -> Posterior | None:
    """Covariances at the solution; None = not positive definite."""
    at_end = PathEquations(with_own_noise(r))
    found = Covariances.of(Equations(at_end.band.copy(), at_end.border, at_end.corner))
    if found is None:
        return None
    shared, (knots, beside) = found.shared, found.blocks(KNOT)
    lever = found.lever.reshape(len(knots), KNOT, -1)
    total = _by_shared(r) - lever
    pose = knots + total @ shared @ np.swapaxes(total, 1, 2)
    mean = np.tile(np.eye(KNOT)[:, :3] / len(knots), (len(knots), 1))
    with_place = found.of_frames(mean).reshape(*total.shape[:2], 3)
    with_place += total @ shared @ total[:, :3].mean(axis=0).T
    place = with_place[:, :3].mean(axis=0)
    pose[:, :, :3] -= with_place
    pose[:, :3] -= np.swapaxes(with_place, 1, 2)
    pose[:, :3, :3] += 2.0 * place  # about the mean place, and that place itself
    knots = knots + lever @ shared @ np.swapaxes(lever, 1, 2)
    beside = beside + lever[:-1] @ shared @ np.swapaxes(lever[1:], 1, 2)
    steps = knots[1:] + knots[:-1] - beside - np.swapaxes(beside, 1, 2)
    fact = r.data.config.views_per_fact
    # Telemetry, whose misalignment is free, holds a path as a whole.
    shape = None if r.weights.free[MISALIGNMENT].any() else np.sqrt(fact) * _shape(r, found, total)
    return Posterior(fact * shared, fact * knots, fact * steps, fact * place, fact * pose, shape)


def _shape(r: PathResiduals, found: Covariances, total: np.ndarray) -> np.ndarray:
    """(K, 2) standard deviations of position and rotation of the knots after the best similarity, by some of them."""
    frame = r.data.knots.frame
    # Some knots will do: each costs six columns of the inverse.
    some = np.unique(np.round(np.linspace(0, len(frame) - 1, 24)).astype(np.intp))
    columns = KNOT * len(some)
    covariance = np.empty((columns, columns))
    for column, node in enumerate(some.tolist()):  # one by one: an hour has a wide inverse
        own = np.zeros((len(frame), KNOT, KNOT))
        own[node] = np.eye(KNOT)
        inverse = found.of_frames(own.reshape(-1, KNOT)).reshape(own.shape)
        covariance[:, KNOT * column : KNOT * (column + 1)] = inverse[some].reshape(columns, KNOT)
    by_shared = total[some].reshape(columns, -1)
    covariance = covariance + by_shared @ found.shared @ by_shared.T
    # Moving, turning and stretching the whole path, one column each, for every node's position and rotation.
    place = r.position[frame[some]]
    about = place - place.mean(axis=0)
    whole = np.zeros((len(some), KNOT, 7))
    whole[:, :3, :3], whole[:, :3, 3:6], whole[:, :3, 6] = np.eye(3), -hat(about), about
    whole[:, 3:, 3:6] = -r.rotation[frame[some]]
    way = max(float(np.linalg.norm(about, axis=1).max()), 1e-9)
    weight = np.tile(np.repeat([1.0 / way, 1.0], 3), len(some))
    free = whole.reshape(columns, 7)
    left = np.eye(columns) - free @ np.linalg.pinv(weight[:, None] * free) * weight
    variance = np.diag(left @ covariance @ left.T).reshape(len(some), 2, 3).mean(axis=2)
    at = np.arange(len(frame))
    return np.stack([np.interp(at, some, np.sqrt(np.maximum(of, 0.0))) for of in variance.T], axis=1)


def with_own_noise(r: PathResiduals) -> PathResiduals:
    """Residuals at the same point and robust weights, with the noise that they show: the priors keep their sizes."""
    # Half of the squared lengths of pairs with a standard deviation of 1 are below 1.39.
    # Simulated points may fit exactly: noise below a thousandth of the expected is that of single precision.
    noise = max(float(np.median(r.square)) / 1.39, 1e-6)
    config = replace(r.data.config, noise_px=r.data.config.noise_px * float(np.sqrt(noise)))
    return PathResiduals(replace(r.data, config=config), r.weights, r.state, r.outlier / noise)


def _by_shared(r: PathResiduals) -> np.ndarray:
    """(K, 6, SHARED) derivatives of the corrected pose at the knots by the shared unknowns."""
    frame = r.data.knots.frame
    out = np.zeros((len(frame), KNOT, SHARED))
    out[:, 3:, MISALIGNMENT] = np.eye(3)
    out[:, 3:, ATTITUDE_LATENCY] = r.turn_rate[frame]
    out[:, :3, POSITION_LATENCY] = r.velocity[frame]
    out[..., ~r.weights.free] = 0.0
    return out


#: Relative decrease of the cost below which the adjustment has converged.
_CONVERGED = 5e-4
#: Tangent of the angle from the image's middle up to the horizon, of a camera that looks down by 15 degrees.
_HORIZON = 0.26
#: Points in a frame below which its camera is the neighbours' alone.
ENOUGH_POINTS = 8


@dataclass(frozen=True)
class AdjustedPath:
    """A path after the adjustment; F frames, J pieces of tracks.

    rotation : (F, 3, 3) world -> camera; position : (F, 3) m
    shared, shared_std : (SHARED,) misalignment (rad, camera axes), latencies of attitude and position (s: the given
        path of so much later is the true one), logarithm of the focal length over the given one; deviation 0 = held,
        NaN = unknown
    facts : of the shared unknowns by points and path alone, without priors
    views : the N observations that were used
    points : (J, 4) x y z m, w: a point at x y z / w; weight : (N,) of the observations, about 0 = wrong
    residual_px : median length of the residuals
    covered : share of frames with enough points
    posterior : covariances of the knots' errors, None = not determined
    """

    rotation: np.ndarray
    position: np.ndarray
    shared: np.ndarray
    shared_std: np.ndarray
    facts: Findings
    views: Views
    points: np.ndarray
    weight: np.ndarray
    residual_px: float
    covered: float
    posterior: Posterior | None
    state: PathState
    cost: float
    iterations: int
    stop_reason: str


def initial_state(data: PathInput, horizon: float = _HORIZON) -> PathState:
    """The given path with the points that it triangulates; ``horizon`` as of :func:`adjust_path`."""
    path = data.path
    # The unit lets points be about one away, which the triangulation and the points' unknowns presume.
    away = np.linalg.norm(path.position - path.position.mean(axis=0), axis=1)
    unit = max(float(away.max()), 1e-9)
    for _ in range(2):
        points = triangulate(data.views, path.rotation, path.position / unit, data.matrix)
        away = np.linalg.norm(points[:, :3], axis=1) / np.maximum(np.abs(points[:, 3]), 1e-6)
        unit *= float(np.clip(np.median(away), 1e-3, 1e3))
    points = triangulate(data.views, path.rotation, path.position / unit, data.matrix)
    if not np.ptp(path.position, axis=0).any():
        # Without any motion depths are unknown.  Ground is nearer in lower parts of the image: equal depths would leave
        # a small motion to the turns, and its sign open.
        below = (data.views.point[:, 1] - data.matrix[1, 2]) / data.matrix[1, 1]
        lower = data.views.of_pieces(below) / np.bincount(data.views.piece)
        points[:, 3] = np.clip(horizon + lower, 0.03, 2.0)  # 1 / distance in heights of the camera
        points, unit = points / np.linalg.norm(points, axis=1, keepdims=True), 1.0
    return PathState(np.zeros((data.knots.count, KNOT)), np.zeros((path.frames, KNOT)), np.zeros(SHARED), points, unit)


def adjust_path(data: PathInput, start: PathState | None = None, horizon: float = _HORIZON) -> AdjustedPath | None:
    """Adjust a given path, its shared errors and the points; None = no track is long enough.

    Frames between the knots add little, as errors of tracks last for longer: they have their say in the rest alone.

    start : where to start instead of at the given path, the rest of the frames left out
    horizon : tangent of the angle from the image's middle up to the horizon: the first depths of a path without motion
    """
    views, kept = _at_knots(data)
    if not len(views.frame):
        return None
    here, done, stop = improved_path(replace(data, views=views), start, horizon)
    posterior, every = posterior_of(here), replace(data, views=data.views.of(kept))
    final = with_rest(PathResiduals(every, here.weights, here.state, here.usual_outlier()))
    return _solution(final, posterior, done, stop)


def rough_path(data: PathInput) -> PathState | None:
    """The first steps of :func:`adjust_path`: how far the errors wander; None = no track is long enough."""
    views, _ = _at_knots(data)
    # After steps that lower the cost by less, the errors' wander changes by a twentieth at most.
    return improved_path(replace(data, views=views), falls=0.02)[0].state if len(views.frame) else None


def _at_knots(data: PathInput) -> tuple[Views, np.ndarray]:
    """The observations in the frames of the knots, and the pieces (J,) that are still long enough."""
    keep = np.zeros(data.path.frames, bool)
    keep[data.knots.frame] = True
    return data.views.at_frames(keep)


def improved_path(
    data: PathInput, start: PathState | None = None, horizon: float = _HORIZON, falls: float = _CONVERGED
) -> tuple[PathResiduals, int, str]:
    """The steps of :func:`adjust_path` alone: where they end, how many there were, and why they ended.

    falls : relative decrease of the cost below which they end
    """
    state = initial_state(data, horizon) if start is None else replace(start, rest=np.zeros_like(start.rest))
    here = PathResiduals(data, weights_of(data), state, OUTLIER_SQUARE)
    stop, done, damping = ITERATIONS, 0, 1e-3  # a share of the diagonal
    for _ in range(data.config.iterations):
        done += 1
        before = here.outlier
        here = here.with_outlier(here.usual_outlier())
        there, damping = _improved(here, damping)
        if there is None:
            stop = NO_DESCENT
            break
        fell, here = 1.0 - there.cost / here.cost, there
        if fell <= falls and here.outlier >= 0.9 * before:
            stop = CONVERGED
            break
    return here, done, stop


def _improved(here: PathResiduals, damping: float) -> tuple[PathResiduals | None, float]:
    """The point after a step that lowers the cost, and the damping of the next one; None = there is none.

    Levenberg-Marquardt: without damping the whole path would turn far on, as only the priors hold it.
    """
    equations = PathEquations(here)
    for _ in range(8):
        step = equations.step(damping)
        if step is not None:
            there = with_points(here.moved(*step))
            if there.cost <= here.cost:
                return there, 0.1 * damping
        damping = 10.0 * max(damping, 1e-6)
    return None, damping


def with_points(r: PathResiduals) -> PathResiduals:
    """Residuals after a step of the points alone, where it lowers their cost."""
    own = r.data.views.of_pieces(np.swapaxes(r.by_point, 1, 2) @ r.by_point) + POINT_WEIGHT * np.eye(3)
    pull = r.data.views.of_pieces(np.einsum("nk,nki->ni", r.weighted, r.by_point))
    there = r.moved(np.zeros_like(r.state.errors), np.zeros(SHARED), -np.linalg.solve(own, pull[..., None])[..., 0])
    lower = r.data.views.of_pieces(there.square * there.robust - r.square * r.robust) < 0.0
    points = np.where(lower[:, None], there.state.points, r.state.points)
    return PathResiduals(r.data, r.weights, replace(r.state, points=points), r.outlier)


def with_rest(r: PathResiduals) -> PathResiduals:
    """Residuals after the rest of each frame has been found, with the points where they are."""
    data, config = r.data, r.data.config
    expected = np.repeat([config.jitter_m, np.deg2rad(config.jitter_deg)], 3) ** -2.0
    # With one step instead of two, a body's scale errs by 0.3 % more.
    for _ in range(2):
        by_view = data.views.of_frames(np.concatenate([r.by_errors, r.weighted[..., None]], axis=2))
        rows = by_view.reshape(data.path.frames, -1, KNOT + 1)
        own = np.swapaxes(rows, 1, 2) @ rows
        right = own[:, :KNOT, KNOT] + expected * r.state.rest
        step = np.linalg.solve(own[:, :KNOT, :KNOT] + np.diag(expected), -right[..., None])[..., 0]
        r = PathResiduals(data, r.weights, replace(r.state, rest=r.state.rest + step), r.outlier)
    return r


def _solution(r: PathResiduals, found: Posterior | None, iterations: int, stop_reason: str) -> AdjustedPath:
    views, length = r.data.views, np.linalg.norm(r.image, axis=1)
    seen = np.bincount(views.frame[r.robust > 0.5], minlength=r.data.path.frames)
    std = np.full(SHARED, np.nan) if found is None else np.sqrt(np.diag(found.shared))
    return AdjustedPath(
        rotation=r.rotation,
        position=r.position,
        shared=r.state.shared,
        shared_std=np.where(r.weights.free, std, 0.0),
        facts=_facts(r, found),
        views=views,
        points=r.state.points * np.array([r.state.unit] * 3 + [1.0]),
        weight=np.square(r.robust),
        residual_px=float(np.median(length)),
        covered=float((seen >= ENOUGH_POINTS).mean()),
        posterior=found,
        state=r.state,
        cost=r.cost,
        iterations=iterations,
        stop_reason=stop_reason,
    )


def _facts(r: PathResiduals, found: Posterior | None) -> Findings:
    """What points and path alone tell of the shared unknowns."""
    free, facts = np.ix_(r.weights.free, r.weights.free), np.zeros((SHARED, SHARED))
    priors = r.weights.shared / r.data.config.views_per_fact
    if found is not None and r.weights.free.any():
        size, axes = np.linalg.eigh(np.linalg.inv(found.shared[free]) - priors[free])
        facts[free] = (axes * np.maximum(size, 0.0)) @ axes.T
    return Findings(facts, (facts + priors) @ r.state.shared)
