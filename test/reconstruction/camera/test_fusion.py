"""Telemetry that errs, corrected by fixed points of the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, Scene, orbit, points_of, seen

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.reconstruction.camera.fusion import Fusion, fuse_telemetry, joints_by_camera
from drocap_ros.reconstruction.common.refusal import Refusal

FPS = 12.0
FRAMES = 90


@pytest.fixture(scope="module")
def true() -> Scene:
    return seen(*orbit(FRAMES, FPS), points_of(np.random.default_rng(2), 160), FPS)


def reported(true: Scene, rotation: np.ndarray | None = None, position: np.ndarray | None = None) -> CameraPath:
    """The scene's camera, exact unless other is given."""
    return CameraPath(
        np.round(np.arange(len(true.position)) * 1e9 / FPS).astype(np.int64),
        true.rotation if rotation is None else rotation,
        true.position if position is None else position,
        MATRIX,
    )


def points_in(true: Scene, noise_px: float = 0.3) -> Background:
    point = true.point + np.random.default_rng(3).normal(0.0, noise_px, true.point.shape)
    return Background(true.frame.astype(np.int32), true.track.astype(np.int64), point.astype(np.float32))


def fused(given: CameraPath, points: Background) -> CameraPath:
    found = fuse_telemetry(given, points)
    assert isinstance(found, Fusion)
    assert found.camera.measured is not None
    return found.camera


def motion_errors(true: Scene, of: CameraPath, lag: int = 36) -> tuple[float, float]:
    """RMS error of the camera's turn (degrees) and way (m, in its axes) within 3 s."""
    turns = [rotation[lag:] @ np.swapaxes(rotation[:-lag], 1, 2) for rotation in (true.rotation, of.rotation)]
    ways = [
        np.einsum("fij,fj->fi", rotation[:-lag], position[lag:] - position[:-lag])
        for rotation, position in ((true.rotation, true.position), of.pose)
    ]
    turned = np.degrees(log_so3(turns[0] @ np.swapaxes(turns[1], 1, 2)))
    return tuple(float(np.sqrt(np.square(error).sum(axis=1).mean())) for error in (turned, ways[0] - ways[1]))


def wave(frames: int, size: float) -> np.ndarray:
    """(F, 3) errors that change within a minute."""
    return size * np.sin(np.arange(frames)[:, None] / FPS * [0.11, 0.15, 0.08] + [0.0, 1.0, 2.0])


def test_points_find_misalignment_and_wander(true: Scene) -> None:
    rotation = exp_so3(np.deg2rad([0.8, -2.5, 0.6]) + np.deg2rad(wave(FRAMES, 1.0))) @ true.rotation
    given = reported(true, rotation, true.position + wave(FRAMES, 0.5))
    before, after = motion_errors(true, given), motion_errors(true, fused(given, points_in(true)))
    assert after[0] < 0.1
    assert after[0] < 0.3 * before[0]
    assert after[1] < 0.1
    assert after[1] < 0.3 * before[1]


def test_a_wrong_yaw_is_found_inside_its_own_interval(true: Scene) -> None:
    # Errors are constant in camera axes; this camera tilts by some degrees, and a yaw about the vertical is not quite.
    north = exp_so3(np.array([0.0, 0.0, np.deg2rad(-1.0)]))
    measured = fused(reported(true, true.rotation @ north), points_in(true)).measured
    found, std = measured["misalignment_deg"][1], measured["misalignment_std_deg"][1]
    assert abs(found) == pytest.approx(1.0, abs=0.3)
    assert abs(abs(found) - 1.0) < 2.5 * std
    assert std < 0.5


def test_a_frozen_part_of_a_log_is_refused_as_without_points(true: Scene) -> None:
    rotation, position = true.rotation.copy(), true.position.copy()
    rotation[30:60], position[30:60] = rotation[30], position[30]
    assert isinstance(fuse_telemetry(reported(true, rotation, position), points_in(true)), Refusal)


def test_late_stamps_are_found(true: Scene) -> None:
    late = 1  # frames, 83 ms
    long = seen(*orbit(FRAMES + late, FPS), points_of(np.random.default_rng(2), 160), FPS)
    keep = long.frame >= late
    seen_later = Scene(
        long.rotation[late:], long.position[late:], long.frame[keep] - late, long.track[keep], long.point[keep], FPS
    )
    measured = fused(reported(seen_later, long.rotation[:-late], long.position[:-late]), points_in(seen_later)).measured
    for name in ("attitude", "position"):
        error = abs(abs(measured[f"{name}_latency_s"]) - late / FPS)
        assert error < 0.02, name
        assert error < 2.5 * measured[f"{name}_latency_std_s"] + 0.005, name


def test_exact_telemetry_stays_exact(true: Scene) -> None:
    turned, moved = motion_errors(true, fused(reported(true), points_in(true)))
    assert turned < 0.03
    assert moved < 0.02


@pytest.mark.parametrize("noise_px", [0.0, 1e-4, 0.01])
@pytest.mark.parametrize("way", [0.0, 1e-4, 0.01, 1.0])
def test_points_without_noise_and_cameras_that_hardly_move_give_finite_errors(way: float, noise_px: float) -> None:
    """As of simulators: a log of a camera that stands says so exactly, and its points stand."""
    rotation, position = orbit(FRAMES, FPS)
    turn = exp_so3(way * log_so3(rotation @ rotation[0].T)) @ rotation[0]
    scene = seen(turn, position[0] + way * (position - position[0]), points_of(np.random.default_rng(2), 160), FPS)
    found = fuse_telemetry(reported(scene), points_in(scene, noise_px))
    if isinstance(found, Fusion):
        pose, covariance = found.camera.pose, found.camera.covariance
        assert all(np.isfinite(values).all() for values in pose)
        assert covariance is not None
        assert np.isfinite(covariance).all()
        assert (np.linalg.eigvalsh(covariance) > -1e-12).all()


def test_the_place_of_a_receiver_is_as_unknown_as_its_wander_whatever_the_noise_of_points(true: Scene) -> None:
    rotation = exp_so3(np.deg2rad(wave(FRAMES, 1.0))) @ true.rotation
    given = reported(true, rotation, true.position + wave(FRAMES, 0.5))
    places = []
    for noise_px in (0.1, 1.0):
        found = fused(given, points_in(true, noise_px))
        places.append(np.sqrt(np.array(found.measured["place_covariance_m2"])[[0, 3, 5]]))
        # The path's shape is known much better than its place.
        about = np.diagonal(found.covariance, axis1=1, axis2=2)[:, :3] - np.square(places[-1])
        assert np.sqrt(about).max() < 0.3
    # The mean of 7.5 s of an error that lasts for a minute is about as large as the error, 0.5 m as expected.
    assert (np.abs(np.array(places) - 0.55) < 0.15).all()
    np.testing.assert_allclose(places[0], places[1], rtol=0.1)


def test_neither_origin_nor_north_matters(true: Scene) -> None:
    north, origin = exp_so3(np.array([0.0, 0.0, 1.1])), np.array([4000.0, -900.0, 30.0])
    rotation = exp_so3(np.deg2rad([0.8, -2.0, 0.5])) @ true.rotation
    place, points = true.position + wave(FRAMES, 0.2), points_in(true)
    turned, moved = fused(reported(true, rotation, place), points).pose
    theirs, there = fused(reported(true, rotation @ north.T, place @ north.T + origin), points).pose
    np.testing.assert_allclose(theirs, turned @ north.T, atol=1e-5)
    np.testing.assert_allclose(there, moved @ north.T + origin, atol=5e-3)


def test_without_points_or_telemetry_nothing_is_measured(true: Scene) -> None:
    given, points = reported(true), points_in(true)
    few = Background(points.frame[:5], points.track[:5], points.point[:5])
    assert fuse_telemetry(given, None) is None
    assert fuse_telemetry(given, few) is None
    for unknown in ("position", "rotation", "matrix"):
        assert fuse_telemetry(replace(given, **{unknown: None}), points) is None


def test_joints_move_as_the_camera_that_sees_them() -> None:
    rng = np.random.default_rng(0)
    rotation, position = exp_so3(rng.normal(size=(4, 3))), rng.normal(size=(4, 3))
    joints = rng.normal(size=(4, 5, 3)) + np.array([0.0, 6.0, 0.0])
    local = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    change = 1e-6 * rng.normal(size=(4, 6))
    moved = local @ (exp_so3(change[:, 3:]) @ rotation) + (position + change[:, :3])[:, None]
    expected = joints_by_camera(joints, rotation, position) @ change[:, None, :, None]
    np.testing.assert_allclose(moved - joints, expected[..., 0], atol=1e-10)
