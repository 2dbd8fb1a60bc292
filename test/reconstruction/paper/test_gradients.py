"""Numeric gradients of every smooth term."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.paper.bundle_adjustment import Objective, articulation_term, articulation_value
from drocap_ros.reconstruction.paper.dictionary import Dictionary
from drocap_ros.reconstruction.paper.reprojection import Projection, information_from, noise_std
from drocap_ros.reconstruction.paper.rotations import update_rotations
from drocap_ros.reconstruction.paper.viewpoint_search import sparse_gradient

F = 7


def numeric(f: Callable[[np.ndarray], float], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    out = np.zeros_like(x)
    for i in np.ndindex(x.shape):
        up, down = x.copy(), x.copy()
        up[i] += step
        down[i] -= step
        out[i] = (f(up) - f(down)) / (2.0 * step)
    return out


@pytest.fixture(params=["plain", "weights", "covariance"])
def projection(request: pytest.FixtureRequest) -> Projection:
    rng = np.random.default_rng(0)
    w = rng.normal(size=(F, 15, 2))
    w[2, 3] = np.nan
    w[4, 5:9] = np.nan
    weights = rng.uniform(0.1, 1.0, (F, 15)) if request.param == "weights" else None
    covariance = None
    if request.param == "covariance":
        root = rng.normal(size=(F, 15, 2, 2))
        full = root @ np.swapaxes(root, 2, 3) + 0.1 * np.eye(2)
        covariance = full[..., [0, 0, 1], [0, 1, 1]]
    return Projection(w, information_from(w, weights, covariance))


@pytest.fixture
def state() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(3, 15, F)), np.moveaxis(exp_so3(rng.normal(size=(F, 3))), 0, -1)


def test_reprojection_gradient(projection: Projection, state: tuple[np.ndarray, np.ndarray]) -> None:
    s, r = state
    value, gradient = projection.value_and_gradient(s, r)
    assert value == pytest.approx(projection.value(s, r))
    assert value == pytest.approx(projection.per_frame(s, r).sum())
    np.testing.assert_allclose(gradient, numeric(lambda x: projection.value(x, r), s), atol=1e-6)


def test_the_translation_is_at_its_optimum(projection: Projection, state: tuple[np.ndarray, np.ndarray]) -> None:
    s, r = state
    pull = projection.inform(projection.residual(s, r)).sum(1)
    np.testing.assert_allclose(pull, 0.0, atol=1e-10)


def test_articulation_gradient(state: tuple[np.ndarray, np.ndarray]) -> None:
    s, _ = state
    value, gradient = articulation_term(s)
    assert value == pytest.approx(articulation_value(s))
    np.testing.assert_allclose(gradient, numeric(articulation_value, s), atol=1e-5, rtol=1e-5)


def test_articulation_vanishes_for_a_rigid_scale(state: tuple[np.ndarray, np.ndarray]) -> None:
    s = state[0][..., :1] * np.linspace(0.5, 2.0, F)
    assert articulation_term(s)[0] == pytest.approx(0.0, abs=1e-12)


def test_gradient_of_the_sum_of_all_terms(projection: Projection, state: tuple[np.ndarray, np.ndarray]) -> None:
    s, r = state
    s = s - s.mean(1, keepdims=True)
    objective = Objective(projection, r, BundleAdjusterConfig(gamma=0.7))
    value, gradient = objective.value_and_gradient(s)
    assert value == pytest.approx(objective.value(s))
    terms = objective.terms(s)
    assert value == pytest.approx(sum(terms.values()) - terms["nuclear_norm"])
    centred = numeric(lambda x: objective.value(x - x.mean(1, keepdims=True)), s)
    np.testing.assert_allclose(gradient, centred, atol=1e-5, rtol=1e-5)


def test_sparse_coefficient_gradient(projection: Projection, dictionary: Dictionary) -> None:
    rng = np.random.default_rng(3)
    basis = dictionary.basis
    c = 0.3 * rng.normal(size=(len(basis), F))
    r = np.moveaxis(exp_so3(rng.normal(size=(F, 3))), 0, -1)

    def value(x: np.ndarray) -> float:
        shape = (basis.T @ x).reshape(3, 15, F)
        return 0.5 * projection.value(shape, r) + 0.5 * 0.4 * np.sum(np.diff(x, axis=1) ** 2)

    np.testing.assert_allclose(sparse_gradient(projection, r, c, basis, 0.4), numeric(value, c), atol=1e-6)


@pytest.mark.parametrize("smoothness", [0.0, 2.0])
def test_rotation_updates_never_raise_the_cost(
    projection: Projection, state: tuple[np.ndarray, np.ndarray], smoothness: float
) -> None:
    s, r = state
    costs = []
    for _ in range(12):
        costs.append(projection.value(s, r) + smoothness * np.sum(np.diff(r) ** 2))
        r = update_rotations(projection, s, r, smoothness=smoothness)
        matrices = np.moveaxis(r, -1, 0)
        np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-9)
    assert np.all(np.diff(costs) <= 1e-9)
    assert costs[-1] < costs[0]


def test_noise_is_measured_and_motion_is_not() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(240) / 24.0
    w = np.sin(2.0 * np.pi * t[:, None, None] * rng.uniform(0.2, 1.0, (15, 2)))
    information = np.tile(np.array([1.0, 0.0, 1.0]), (240, 15, 1))
    assert noise_std(w, information) < 0.005
    noisy = w + rng.normal(0.0, 0.05, w.shape)
    gross = rng.random((240, 15)) < 0.05
    noisy[gross] += 3.0
    assert noise_std(noisy, information) == pytest.approx(0.05, rel=0.35)
    information[:, 3] = 0.0
    noisy[:, 3] = 77.0
    assert noise_std(noisy, information) == pytest.approx(0.05, rel=0.35)
    assert noise_std(w[:5], information[:5]) == 0.0
    assert noise_std(w, 0.0 * information) == 0.0
