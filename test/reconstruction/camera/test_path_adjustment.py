"""The adjustment of a camera's path by fixed points: derivatives, exact recovery, errors it states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, Scene, looking, orbit, points_of, seen, shape_error, turn_errors_deg

from drocap_ros.camera_path import CameraErrors
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.reconstruction.camera.path_adjustment import adjust_path, initial_state, posterior_of, with_own_noise
from drocap_ros.reconstruction.camera.path_model import (
    ATTITUDE_LATENCY,
    KNOT,
    MISALIGNMENT,
    POSITION_LATENCY,
    SHARED,
    PathConfig,
    PathInput,
    views_of,
)
from drocap_ros.reconstruction.camera.path_residuals import PathEquations, PathResiduals, gradient, weights_of
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry

FPS = 12.0
CONFIG = PathConfig(CameraErrors(yaw_deg=2.0, tilt_deg=1.0), focal=0.1)


def scene(frames: int = 60, points: int = 300) -> Scene:
    rng = np.random.default_rng(5)
    return seen(*orbit(frames, FPS), points_of(rng, points), FPS)


def given(true: Scene, turned_deg: float = 0.0, moved_m: float = 0.0, config: PathConfig = CONFIG) -> PathInput:
    """The true path with a constant misalignment and a wave of its position."""
    rotation = exp_so3(np.deg2rad(turned_deg) * np.array([0.5, 1.0, -0.3])) @ true.rotation
    wave = np.sin(np.arange(len(rotation))[:, None] / 40.0 * [1.0, 1.3, 0.7])
    views = views_of(true.frame, true.track, true.point, len(rotation), FPS)
    return PathInput(CameraTelemetry(rotation, true.position + moved_m * wave, FPS), MATRIX, views, config)


def residuals(rng: np.random.Generator, data: PathInput) -> PathResiduals:
    """A point beside the solution, as no term may vanish."""
    state = initial_state(data)
    state = replace(
        state,
        errors=0.01 * rng.standard_normal(state.errors.shape),
        rest=0.001 * rng.standard_normal(state.rest.shape),
        shared=0.01 * rng.standard_normal(SHARED),
    )
    return PathResiduals(data, weights_of(data), state, 25.0)


def test_gradient_is_the_slope_of_the_cost() -> None:
    rng = np.random.default_rng(0)
    r = residuals(rng, given(scene(30, 60), 1.0, 0.1))
    shapes = r.state.errors.shape, (SHARED,), (len(r.state.points), 3)
    for part, by_part in enumerate(gradient(r)):
        step = [np.zeros(shape) for shape in shapes]
        step[part] = rng.standard_normal(shapes[part])
        if part == 1:
            step[part][POSITION_LATENCY] = 0.0
        assert (by_part * step[part]).sum() == pytest.approx(slope(r, step), rel=2e-5)


def test_gradient_by_the_latency_of_the_position_is_the_slope_on_a_straight_path() -> None:
    # Between frames a path is a line, whose slope is the smoothed velocity on a straight path alone.
    position = np.arange(30)[:, None] * [0.1, 0.05, 0.01] + [-4.0, 5.0, 2.0]
    rotation = looking(position, np.zeros((30, 3)))
    data = given(seen(rotation, position, points_of(np.random.default_rng(4), 80), FPS), 1.0)
    r = residuals(np.random.default_rng(0), data)
    step = [np.zeros(r.state.errors.shape), np.eye(SHARED)[POSITION_LATENCY], np.zeros((len(r.state.points), 3))]
    assert gradient(r)[1][POSITION_LATENCY] == pytest.approx(slope(r, step), rel=2e-5)


def slope(r: PathResiduals, step: list[np.ndarray], h: float = 1e-6) -> float:
    there, back = (r.moved(*(sign * s for s in step)) for sign in (h, -h))
    return (there.cost - back.cost) / (2 * h)


def test_step_solves_the_normal_equations_of_all_unknowns() -> None:
    rng = np.random.default_rng(1)
    data = given(scene(24, 40), 1.0, 0.1)
    r = residuals(rng, data)
    step = PathEquations(r).step()
    assert step is not None
    errors, shared, points = step
    image, by_point, by_camera = r.weighted, r.by_point, r.by_camera
    knots, views = data.knots, data.views
    used = KNOT * knots.count
    rows = np.zeros((len(image), 2, used + SHARED + 3 * len(views.track)))
    for i, (frame, piece) in enumerate(zip(views.frame, views.piece, strict=True)):
        for k, share in ((0, 1.0 - knots.share[frame]), (1, knots.share[frame])):
            at = KNOT * (knots.before[frame] + k)
            rows[i, :, at : at + KNOT] += share * by_camera[i, :, :KNOT]
        rows[i, :, used : used + SHARED] = by_camera[i, :, KNOT:]
        rows[i, :, used + SHARED + 3 * piece : used + SHARED + 3 * piece + 3] = by_point[i]
    flat = rows.reshape(-1, rows.shape[2])
    change = np.concatenate([errors.reshape(-1), shared, points.reshape(-1)])
    # The terms in time have a gradient that is linear in the errors and the shared unknowns.
    moved = replace(r.state, errors=r.state.errors + errors, shared=r.state.shared + shared)
    before, after = (PathResiduals(data, r.weights, state, 1e-12) for state in (r.state, moved))
    of_time = np.concatenate([(a - b).reshape(-1) for a, b in zip(gradient(after), gradient(before), strict=True)])
    pull = flat.T @ image.reshape(-1)
    curved = flat.T @ (flat @ change) + of_time
    curved[used + SHARED :] += 10.0 * points.reshape(-1)  # what holds points without parallax
    np.testing.assert_allclose(
        curved, -np.concatenate([g.reshape(-1) for g in gradient(r)]), atol=1e-4 * abs(pull).max()
    )


def test_noise_free_views_recover_misalignment_wander_and_focal_length_exactly() -> None:
    true = scene(96)
    # Weights of the priors vanish beside views without noise.
    config = replace(
        CONFIG,
        errors=replace(CONFIG.errors, latency_s=0.0, position_wander_m=0.3),
        noise_px=1e-3,
        focal=0.1,
        iterations=40,
        jitter_m=0.01,
    )
    data = given(true, 1.0, 0.1, config)
    longer = np.diag([1.03, 1.03, 1.0])
    found = adjust_path(replace(data, matrix=np.column_stack([(MATRIX @ longer)[:, :2], MATRIX[:, 2]])))
    assert found is not None
    assert found.residual_px < 0.02
    turned = turn_errors_deg(found.rotation, true.rotation, FPS)
    assert turned.max() < 0.01
    assert np.exp(found.shared[5]) * 1.03 == pytest.approx(1.0, abs=1e-3)
    assert shape_error(found.position, true.position) < 0.01


def test_deviations_are_those_of_the_dense_inverse() -> None:
    r = residuals(np.random.default_rng(2), given(scene(48, 60), 1.0, 0.1))
    found, equations = posterior_of(r), PathEquations(with_own_noise(r))
    assert found is not None
    size = len(equations.border)
    full = np.zeros((size + SHARED, size + SHARED))
    for d in range(equations.band.shape[1]):
        at = np.arange(size - d)
        full[at, at + d] = full[at + d, at] = equations.band[: size - d, d]
    full[:size, size:], full[size:, size:] = equations.border, equations.corner
    full[size:, :size] = equations.border.T
    inverse = np.linalg.inv(full)
    scale = found.shared[0, 0] / inverse[size, size]
    np.testing.assert_allclose(found.shared, scale * inverse[size:, size:], rtol=1e-4, atol=1e-12)
    knots = inverse[:size, :size].reshape(size // KNOT, KNOT, size // KNOT, KNOT)
    for k in range(size // KNOT):
        np.testing.assert_allclose(found.knots[k], scale * knots[k, :, k], rtol=1e-3, atol=1e-9)
    # What all poses have in common, and what they have beside it.
    by = np.zeros((size // KNOT, KNOT, size + SHARED))
    for k in range(size // KNOT):
        by[k, :, KNOT * k : KNOT * (k + 1)] = np.eye(KNOT)
    frame = r.data.knots.frame
    by[:, 3:, size + MISALIGNMENT.start : size + MISALIGNMENT.stop] = np.eye(3)
    by[:, 3:, size + ATTITUDE_LATENCY] = r.turn_rate[frame]
    by[:, :3, size + POSITION_LATENCY] = r.velocity[frame]
    by[..., size:] *= r.weights.free
    mean = by[:, :3].mean(axis=0)
    np.testing.assert_allclose(found.place, scale * mean @ inverse @ mean.T, rtol=1e-3, atol=1e-9)
    by[:, :3] -= mean
    for k in (0, 5):
        pose = scale * by[k] @ inverse @ by[k].T
        pose[:3, :3] += found.place
        np.testing.assert_allclose(found.pose[k], pose, rtol=1e-3, atol=1e-8)
    step = knots[3, :, 3] + knots[4, :, 4] - knots[3, :, 4] - knots[4, :, 3]
    np.testing.assert_allclose(found.steps[3], scale * step, rtol=1e-3, atol=1e-9)


def test_points_that_slide_lose_their_weight() -> None:
    true = scene(96)
    rng = np.random.default_rng(3)
    tracks = np.unique(true.track)
    bad = rng.choice(tracks, len(tracks) // 8, replace=False)
    slides = np.isin(true.track, bad)
    drift = rng.normal(0.0, 1.0, (len(tracks), 2))[np.searchsorted(tracks, true.track)]
    point = true.point + 0.4 * rng.standard_normal(true.point.shape)
    point[slides] += (true.frame[:, None] % 36 * 3.0 * drift)[slides]
    found = adjust_path(given(true._replace(point=point), 1.0, 0.1))
    assert found is not None
    weight = np.bincount(found.views.piece, found.weight) / np.bincount(found.views.piece)
    wrong = np.isin(found.views.track, bad)
    assert np.median(weight[wrong]) < 0.3 < 0.8 < np.median(weight[~wrong])
    turned = turn_errors_deg(found.rotation, true.rotation, FPS)
    assert np.sqrt(np.mean(turned**2)) < 0.05


def test_origin_north_and_unit_of_the_scene_do_not_matter() -> None:
    true = scene(48)
    data = given(true, 1.0, 0.1, replace(CONFIG, errors=replace(CONFIG.errors, latency_s=0.0)))
    found = adjust_path(data)
    turn, unit = exp_so3(np.array([0.0, 0.0, 2.0])), 3.0
    path = CameraTelemetry(data.path.rotation @ turn.T, unit * (data.path.position @ turn.T + [40.0, -30.0, 5.0]), FPS)
    errors = data.config.errors
    wander_m, acceleration = unit * errors.position_wander_m, unit * errors.acceleration_m_s2
    errors = replace(errors, position_wander_m=wander_m, acceleration_m_s2=acceleration)
    config = replace(data.config, errors=errors, jitter_m=unit * CONFIG.jitter_m)
    other = adjust_path(PathInput(path, MATRIX, data.views, config))
    assert found is not None
    assert other is not None
    np.testing.assert_allclose(other.rotation @ turn, found.rotation, atol=2e-5)
    np.testing.assert_allclose((other.position / unit - [40.0, -30.0, 5.0]) @ turn, found.position, atol=2e-3)
