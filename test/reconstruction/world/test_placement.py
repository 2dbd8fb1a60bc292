"""Scale and place in the world from the camera's telemetry."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from walking import stamps

from drocap_ros.camera_path import CameraPath
from drocap_ros.evaluation.metrics import scale_error
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.reconstruction.world.placement import estimate_scale, metres_per_px, place_in_world, smooth_over_time
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import SimulatedCapture, SimulationConfig, simulate_capture
from lab.simulation.orbit import orbit_camera

ANKLES = [BODY_15.index("lankle"), BODY_15.index("rankle")]


def capture(stature_m: float) -> SimulatedCapture:
    config = SimulationConfig(
        stature_m=stature_m,
        noise_scale=0.0,
        outlier_fraction=0.0,
        missed_fraction=0.0,
        attitude_error_deg=0.0,
        position_error_m=0.0,
    )
    return simulate_capture(10.0, 24.0, seed=1, config=config)


@pytest.mark.parametrize("true_factor", [0.8, 1.0, 1.25])
def test_still_feet_determine_the_scale(true_factor: float) -> None:
    t = np.arange(240) / 24.0
    person = simulate_person(t, action="walk", seed=0)
    _, position = orbit_camera(t, person[:, 0], radius_m=6.0, height_m=2.0, speed_deg_s=25.0)
    feet = (person[:, ANKLES] - position[:, None]) / true_factor
    found = estimate_scale(feet, position, stamps(240))
    assert found is not None
    assert found.trusted
    assert found.factor == pytest.approx(true_factor, rel=0.02)


def test_a_still_camera_gives_no_scale() -> None:
    t = np.arange(240) / 24.0
    person = simulate_person(t, action="walk", seed=0)
    assert estimate_scale(person[:, ANKLES] + 6.0, np.zeros((240, 3)), stamps(240)) is None


def test_feet_that_never_stand_give_no_trusted_scale() -> None:
    """Somebody on a swing or a bicycle: no factor keeps the feet still."""
    rng = np.random.default_rng(0)
    t = np.arange(240) / 24.0
    feet = np.cumsum(rng.normal(0.0, 0.15, (240, 2, 3)), axis=0)
    _, position = orbit_camera(t, np.zeros((240, 3)), radius_m=6.0, height_m=2.0, speed_deg_s=25.0)
    found = estimate_scale(feet - position[:, None], position, stamps(240))
    assert found is None or not found.trusted


@pytest.mark.parametrize("stature_m", [1.50, 1.95])
def test_a_moving_camera_measures_the_stature(stature_m: float) -> None:
    """Assumed are 1.70 m; what is found is nearer the truth than that, and is marked as measured."""
    truth = capture(stature_m)
    motion = reconstruct(truth.tracks, method="paper")
    assert (motion.frame, motion.metric, motion.scale_source) == ("world", True, "telemetry")
    assert 0.2 < motion.meta["scale"]["support"] <= 1.0
    assumed = abs(1.70 / stature_m - 1.0)
    assert abs(scale_error(motion.joints3d, truth.joints3d_world)) < 0.6 * assumed
    assert np.linalg.norm(motion.joints3d[:, 0] - truth.joints3d_world[:, 0], axis=1).mean() < 0.3


def test_joints_stay_on_their_pixels() -> None:
    truth = capture(1.75)
    motion = reconstruct(truth.tracks, method="paper")
    assert truth.tracks.camera_position is not None
    assert truth.tracks.camera_matrix is not None
    seen = (motion.joints3d - truth.tracks.camera_position[:, None]) @ np.swapaxes(motion.camera_rotation, 1, 2)
    k = truth.tracks.camera_matrix
    px = seen[..., :2] / seen[..., 2:] * np.diagonal(k)[:2] + k[:2, 2]
    gap = np.linalg.norm(px - motion.keypoints, axis=-1)
    np.testing.assert_allclose(gap, motion.reprojection_px, atol=1e-6)


def test_without_a_position_the_pelvis_stays_at_the_origin() -> None:
    tracks = dataclasses.replace(capture(1.75).tracks, camera_position=None)
    motion = reconstruct(tracks, method="initial")
    assert (motion.frame, motion.metric, motion.scale_source) == ("world", False, "assumed_height")
    np.testing.assert_allclose(motion.joints3d[:, 0], 0.0, atol=1e-12)


def test_placement_is_the_back_projection() -> None:
    truth = capture(1.75)
    x = truth.joints3d_world
    camera = (x - truth.camera_position[:, None]) @ np.swapaxes(truth.camera_rotation, 1, 2)
    k = truth.tracks.camera_matrix
    assert k is not None
    per_px = camera[:, 0, 2] / k[0, 0]
    exact = CameraPath(truth.tracks.stamp_ns, truth.camera_rotation, truth.camera_position, k)
    placed = place_in_world(camera - camera[:, :1], truth.keypoints_exact, per_px, exact)
    assert placed.metric
    np.testing.assert_allclose(placed.joints, x, atol=0.15)
    depth_only = dataclasses.replace(exact, stamp_ns=exact.stamp_ns * 1000)  # no two frames near in time
    placed = place_in_world(camera - camera[:, :1], truth.keypoints_exact, per_px, depth_only)
    assert not placed.metric
    np.testing.assert_allclose(placed.joints, x, atol=1e-6)


def test_size_is_averaged_over_time() -> None:
    body = np.abs(np.random.default_rng(0).normal(size=(1, 15, 3)))
    joints = body * np.linspace(100.0, 110.0, 100)[:, None, None]
    per_px = metres_per_px(joints, stamps(100), 1.7)
    assert np.all(np.diff(per_px) < 0.0)
    constant = smooth_over_time(np.full((50, 2), 3.0), stamps(50), 1.0)
    np.testing.assert_allclose(constant, 3.0)
    counted = smooth_over_time(np.arange(20.0), np.arange(20), 1.0)  # frames counted as nanoseconds
    assert np.ptp(counted) < 10.0
    np.testing.assert_array_equal(smooth_over_time(np.array([5.0]), stamps(1), 1.0), [5.0])
