"""The adjustment: derivatives of the cost, normal equations, descent."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from drocap_ros.reconstruction.lifted.adjustment import (
    SPANS,
    AdjustmentProblem,
    _band,
    _border,
    _gradient,
    _Residuals,
    adjust,
    span_lengths,
    zoom_model,
)


def problem(frames: int = 6, seed: int = 0) -> tuple[AdjustmentProblem, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    basis, precision = zoom_model(frames, 3.0, 0.05)
    joints = rng.normal(0, 300, (frames, 17, 3))
    size = rng.uniform(0, 0.1, (frames, 17, 2)) * (rng.random((frames, 17, 1)) < 0.8)
    across = rng.uniform(-0.9, 0.9, (frames, 17)) * np.sqrt(size.prod(axis=-1))
    p = AdjustmentProblem(
        keypoints=joints[..., :2] + rng.normal(0, 10, (frames, 17, 2)),
        information=np.stack([size[..., 0], across, size[..., 1]], axis=-1),
        prior=joints + rng.normal(0, 30, joints.shape),
        prior_weight_xy=rng.uniform(0, 0.01, (frames, 17)),
        prior_weight_z=rng.uniform(0, 0.05, (frames, 17)),
        acceleration_weight=1e-3,
        zoom_basis=basis,
        zoom_precision=precision,
        lengths=1.02 * span_lengths(joints).mean(axis=0),
        length_weight=0.02,
    )
    return p, joints, span_lengths(joints).mean(axis=0)


def test_gradient_is_the_derivative_of_the_cost():
    p, joints, lengths = problem()
    zooms = np.random.default_rng(1).normal(0, 0.05, p.zoom_basis.shape[1])
    g, g_sizes = _gradient(p, _Residuals(p, joints, lengths, zooms))
    flat = np.concatenate([joints.ravel(), lengths, zooms])
    analytic = np.concatenate([g.ravel(), g_sizes])

    def cost(x: np.ndarray) -> float:
        n, m = joints.size, len(lengths)
        return _Residuals(p, x[:n].reshape(joints.shape), x[n : n + m], x[n + m :]).cost

    rng = np.random.default_rng(2)
    for i in [*rng.integers(0, joints.size, 40), *range(joints.size, len(flat))]:
        step = np.zeros_like(flat)
        step[i] = 1e-4 * max(1.0, abs(flat[i]) * 1e-2)
        numeric = (cost(flat + step) - cost(flat - step)) / (2 * step[i])
        assert numeric == pytest.approx(analytic[i], rel=1e-4, abs=1e-5)


def test_normal_equations_are_positive_and_their_corner_is_the_second_derivative():
    p, joints, lengths = problem(frames=4)
    zooms = np.zeros(p.zoom_basis.shape[1])
    r = _Residuals(p, joints, lengths, zooms)
    band = _band(p, r)
    n = joints.size
    dense = np.zeros((n, n))
    for d in range(band.shape[1]):
        i = np.arange(n - d)
        dense[i + d, i] = dense[i, i + d] = band[: n - d, d]
    border, corner = _border(p, r)
    whole = np.block([[dense, border], [border.T, corner]])
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.abs(whole).max()
    # The cost of lengths and zoom is (nearly) quadratic: the corner is its second derivative.
    _, before = _gradient(p, r)
    for k in range(len(SPANS)):
        step = np.zeros(len(lengths))
        step[k] = 1e-3
        _, after = _gradient(p, _Residuals(p, joints, lengths + step, zooms))
        np.testing.assert_allclose((after - before)[: len(SPANS)] / 1e-3, corner[: len(SPANS), k], rtol=1e-6, atol=1e-9)


def test_cost_never_rises_and_the_stop_reason_is_reported():
    p, joints, _ = problem(frames=20)
    start = joints + np.random.default_rng(3).normal(0, 50, joints.shape)
    costs = [sum(adjust(p, start, k, tolerance=0.0).cost_terms.values()) for k in range(6)]
    assert all(b <= a for a, b in pairwise(costs))
    assert adjust(p, start, 500).stop_reason in ("converged", "no descent")
    assert adjust(p, start, 1, tolerance=0.0).stop_reason == "iterations"


def test_lasting_noise_does_not_lengthen_bones_that_are_known():
    """A person seen through 2D joints whose errors last: the lengths hardly leave those that were given."""
    p, joints, lengths = problem(frames=20)
    free = replace(p, keypoints=1.05 * joints[..., :2], lengths=lengths, length_weight=0.0)
    held = replace(free, length_weight=1e3)
    change = [float(np.abs(adjust(q, joints, 10).lengths / lengths - 1).mean()) for q in (free, held)]
    assert change[1] < 0.1 * change[0]


def test_a_joint_moves_along_the_direction_in_which_it_is_uncertain():
    p, joints, lengths = problem(frames=8)
    none = np.zeros((8, 17, 3))
    none[..., [0, 2]] = 0.01
    none[:, 11] = [0.01, -0.0099, 0.01]  # certain across the diagonal, free along it
    zero = np.zeros((8, 17))
    target = joints[..., :2].copy()
    target[:, 11] += [30.0, 0.0]
    p = replace(p, keypoints=target, information=none, prior=joints, prior_weight_xy=zero + 1e-4, prior_weight_z=zero)
    p = replace(p, acceleration_weight=0.0, lengths=lengths)
    moved = adjust(p, joints, 30).joints - joints
    along, across = moved[:, 11, :2] @ [0.5**0.5, 0.5**0.5], moved[:, 11, :2] @ [0.5**0.5, -(0.5**0.5)]
    assert np.median(np.abs(across)) > 10.0
    assert np.median(np.abs(along)) < 0.7 * np.median(np.abs(across))
