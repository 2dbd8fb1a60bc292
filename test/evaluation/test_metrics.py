"""Error measures on motions whose errors are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from walking import Walk

from drocap_ros.evaluation import metrics
from drocap_ros.evaluation.compare import compare, world_errors
from drocap_ros.evaluation.tables import WORLD_HEAD, world_cells
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.studies.protocol import FPS, Sequence
from lab.studies.world_protocol import world_view


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


def in_world(walk: Walk) -> np.ndarray:
    return walk.in_camera @ walk.camera


def test_no_error_is_zero_by_every_measure(walk: Walk) -> None:
    truth = in_world(walk)
    errors = world_errors(truth, truth, FPS, np.tile([1e-4, 0, 0, 1e-4, 0, 1e-4], (*truth.shape[:2], 1)))
    for name in ("pa_mm", "mpjpe_mm", "w_mm", "wa_mm", "absolute_mm", "root_percent", "scale", "penetration_mm"):
        assert getattr(errors, name) == pytest.approx(0.0, abs=1e-6), name
    assert errors.acceleration_ratio == pytest.approx(1.0)
    assert errors.acceleration_error_m_s2 == 0.0
    assert errors.coverage == 1.0


def test_a_shift_counts_only_without_alignment(walk: Walk) -> None:
    truth = in_world(walk)
    errors = world_errors(truth + np.array([0.3, 0.0, 0.4]), truth, FPS)
    assert errors.absolute_mm == pytest.approx(500.0)
    assert errors.w_mm == pytest.approx(0.0, abs=1e-6)
    assert errors.wa_mm == pytest.approx(0.0, abs=1e-6)
    assert errors.root_percent == pytest.approx(0.0, abs=1e-6)


def test_a_body_that_sinks_penetrates_the_ground(walk: Walk) -> None:
    truth = in_world(walk)
    truth[:, metrics.FEET, 2] = 0.0
    assert world_errors(truth - np.array([0.0, 0.0, 0.02]), truth, FPS).penetration_mm == pytest.approx(20.0)
    assert world_errors(truth + np.array([0.0, 0.0, 0.02]), truth, FPS).penetration_mm == 0.0


def test_feet_count_only_where_the_true_ones_are_still() -> None:
    truth = np.zeros((49, 15, 3))
    truth[24:, metrics.FEET[0], 0] = 0.2 * np.arange(25)  # 4.8 m/s
    estimate = truth + np.arange(49.0)[:, None, None] * [0.01, 0.0, 0.0]  # slides by 0.24 m/s everywhere
    assert metrics.still_foot_speed(estimate, truth, 24.0) == pytest.approx(0.24)
    moving = np.arange(49.0)[:, None, None] * np.full((1, 15, 3), 0.1)
    assert np.isnan(metrics.still_foot_speed(moving, moving, 24.0))


def test_root_error_is_a_share_of_the_path() -> None:
    truth = np.zeros((101, 15, 3))
    truth[..., 0] = 0.1 * np.arange(101)[:, None]  # 10 m straight
    estimate = truth.copy()
    estimate[..., 0] *= 1.04  # aligned at its middle, the ends are 0.2 m off and the mean 0.1 m
    assert metrics.root_error(estimate, truth) == pytest.approx(0.01, rel=0.02)


def test_coverage_of_ellipsoids_that_are_true_is_90_percent() -> None:
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(3, 3))
    matrix = spread @ spread.T
    truth = np.zeros((400, 15, 3))
    estimate = rng.multivariate_normal(np.zeros(3), matrix, truth.shape[:2])
    packed = np.broadcast_to(matrix[np.triu_indices(3)], (400, 15, 6))
    assert metrics.ellipsoid_coverage(estimate, truth, packed) == pytest.approx(0.9, abs=0.015)
    assert metrics.ellipsoid_coverage(estimate, truth, 0.25 * packed) < 0.5
    assert np.isnan(metrics.ellipsoid_coverage(estimate, truth, np.full((400, 15, 6), np.nan)))


def test_acceleration_over_that_of_a_truth_that_does_not_move_is_unknown(walk: Walk) -> None:
    moving = in_world(walk)
    errors = world_errors(moving, np.repeat(moving[:1], len(moving), axis=0), FPS)
    assert np.isnan(errors.acceleration_ratio)
    assert world_cells(errors)[WORLD_HEAD.index("acceleration ratio")] == "-"


def test_ellipsoids_about_the_pelvis_are_not_compared_with_places_in_the_world() -> None:
    view = world_view(Sequence("walk", 1000.0 * simulate_person(np.arange(120) / FPS, "walk", 1, 1.75, BODY_15)))
    time_s = np.arange(len(view.truth)) / FPS
    for position, about in ((view.tracks.camera_position, "origin"), (None, "pelvis")):
        motion = reconstruct(replace(view.tracks, camera_position=position))
        assert motion.covariance is not None
        assert motion.meta["covariance_about"] == about
        errors = compare(motion, view.truth, time_s, "world").world
        assert errors is not None
        assert np.isnan(errors.coverage) == (about == "pelvis")
