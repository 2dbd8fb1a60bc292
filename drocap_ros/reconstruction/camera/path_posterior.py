"""Covariances of a camera's path after the adjustment."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import hat
from drocap_ros.reconstruction.camera.path_equations import PathEquations
from drocap_ros.reconstruction.camera.path_model import ATTITUDE_LATENCY, KNOT, MISALIGNMENT, POSITION_LATENCY, SHARED
from drocap_ros.reconstruction.camera.path_residuals import PathResiduals
from drocap_ros.reconstruction.common.engine import Covariances, Equations

#: Knots of which the deviations after the best similarity are computed: each costs six columns of the inverse.
_NODES = 24
#: Half of the squared lengths of pairs with a standard deviation of 1 are below it.
_MEDIAN_SQUARE = 1.39


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
    some = np.unique(np.round(np.linspace(0, len(frame) - 1, _NODES)).astype(np.intp))
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
    noise = max(float(np.median(r.square)) / _MEDIAN_SQUARE, 1e-12)
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
