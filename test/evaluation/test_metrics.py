"""Error measures on motions whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walking import Walk

from drocap_ros.evaluation import metrics
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.skeleton import BODY_15


def test_reconstruction_error_ignores_similarity_but_not_mirroring(walk: Walk) -> None:
    truth = 1000.0 * walk.shape
    moved = 0.2 * truth @ Rotation.random(120, random_state=0).as_matrix() + 9.0
    np.testing.assert_allclose(metrics.pa_mpjpe(moved, truth), 0.0, atol=1e-9)
    mirrored = truth * np.array([1.0, -1.0, 1.0])
    assert metrics.pa_mpjpe(mirrored, truth).mean() > 30.0
    assert metrics.is_mirrored(mirrored, truth)
    assert metrics.mirrored_frames(mirrored, truth).mean() > 0.9
    assert not metrics.mirrored_frames(truth, truth).any()


def test_reconstruction_error_uses_the_twelve_limb_joints(walk: Walk) -> None:
    other = 1000.0 * walk.shape
    other[:, BODY_15.index("head")] += 500.0
    np.testing.assert_allclose(metrics.pa_mpjpe(other, 1000.0 * walk.shape), 0.0, atol=1e-9)


def test_alignment_is_the_best_similarity(walk: Walk) -> None:
    rng = np.random.default_rng(0)
    truth = 1000.0 * walk.shape[:5]
    estimate = truth + rng.normal(0.0, 60.0, truth.shape)
    best = metrics.aligned_error(estimate, truth)
    assert np.all(np.sum(best**2, 1) <= np.sum(np.linalg.norm(estimate - truth, axis=-1) ** 2, axis=1))


def test_world_error_aligns_on_the_first_two_frames(walk: Walk) -> None:
    truth = 1000.0 * walk.in_camera @ walk.camera
    turn = exp_so3(np.array([0.3, -0.2, 1.0]))
    np.testing.assert_allclose(metrics.w_mpjpe(truth @ turn.T + 77.0, truth), 0.0, atol=1e-8)
    drift = truth + np.arange(120.0)[:, None, None] * np.array([10.0, 0.0, 0.0])
    error = metrics.w_mpjpe(drift, truth)
    other = truth.copy()
    other[2:, BODY_15.index("head")] += 150.0 / np.sqrt(3)
    np.testing.assert_allclose(metrics.w_mpjpe(other, truth)[2:100], 10.0)  # a joint of fifteen
    np.testing.assert_allclose(error[99], 985.0, atol=20.0)
    assert error[100] < 20.0  # every segment has its own alignment


def test_scale_error_is_relative_to_the_truth(walk: Walk) -> None:
    assert metrics.scale_error(1.1 * walk.shape, walk.shape) == pytest.approx(0.1)


def test_horizon_error_is_the_tilt_of_the_vertical(walk: Walk) -> None:
    world = walk.in_camera @ walk.camera
    heading, tilt = exp_so3(np.array([0.0, 0.0, 2.0])), exp_so3(np.array([0.25, 0.0, 0.0]))
    np.testing.assert_allclose(metrics.horizon_error(world @ heading.T, world), 0.0, atol=1e-6)
    np.testing.assert_allclose(metrics.horizon_error(world @ (tilt @ heading).T, world), 0.25, atol=1e-6)


def test_group_errors_average_to_the_reconstruction_error(walk: Walk) -> None:
    rng = np.random.default_rng(0)
    truth = 1000.0 * walk.shape
    estimate = truth + rng.normal(0.0, 30.0, truth.shape)
    groups = metrics.group_errors(estimate, truth)
    assert set(groups) == {"wrist", "elbow", "shoulder", "hip", "knee", "ankle"}
    assert np.mean(list(groups.values())) == pytest.approx(metrics.pa_mpjpe(estimate, truth).mean())
