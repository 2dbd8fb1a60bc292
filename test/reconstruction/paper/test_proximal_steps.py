"""Proximal steps by identity: Moreau decomposition, firm non-expansiveness, optimality."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drocap_ros.reconstruction.paper.bundle_adjustment import nuclear_norm, singular_value_threshold
from drocap_ros.reconstruction.paper.dictionary import soft_threshold

Step = Callable[[np.ndarray, float], np.ndarray]


def low_rank(x: np.ndarray, tau: float) -> np.ndarray:
    return singular_value_threshold(x, tau)[0]


def project_on_nuclear_dual(x: np.ndarray, tau: float) -> np.ndarray:
    """Projection on the matrices of spectral norm <= tau, the dual ball of the nuclear norm."""
    u, s, vt = np.linalg.svd(x, full_matrices=False)
    return (u * np.minimum(s, tau)) @ vt


def project_on_box(x: np.ndarray, tau: float) -> np.ndarray:
    return np.clip(x, -tau, tau)


CASES: list[tuple[Step, Step, tuple[int, ...]]] = [
    (soft_threshold, project_on_box, (30, 20)),
    (low_rank, project_on_nuclear_dual, (45, 80)),
    (low_rank, project_on_nuclear_dual, (45, 12)),
]


@pytest.mark.parametrize(("prox", "dual", "shape"), CASES)
@pytest.mark.parametrize("tau", [0.01, 0.7, 30.0])
def test_moreau_decomposition(prox: Step, dual: Step, shape: tuple[int, ...], tau: float) -> None:
    x = np.random.default_rng(0).normal(size=shape)
    np.testing.assert_allclose(prox(x, tau) + dual(x, tau), x, atol=1e-9)


@pytest.mark.parametrize(("prox", "dual", "shape"), CASES)
def test_firm_non_expansiveness(prox: Step, dual: Step, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    for tau in (0.1, 1.0, 5.0):
        x, y = rng.normal(size=shape), rng.normal(size=shape)
        px, py = prox(x, tau), prox(y, tau)
        assert np.vdot(px - py, px - py) <= np.vdot(px - py, x - y) + 1e-10


def test_thresholding_reports_the_norm_of_its_result() -> None:
    x = np.random.default_rng(2).normal(size=(3, 15, 60))
    new, norm = singular_value_threshold(x, 2.0)
    assert norm == pytest.approx(nuclear_norm(new), rel=1e-9)
    assert nuclear_norm(x) == pytest.approx(np.linalg.svd(x.reshape(45, 60), compute_uv=False).sum(), rel=1e-9)
