"""Telemetry that errs, corrected by fixed points of the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixed_points import MATRIX, SIZE, Scene, orbit, points_of, seen

from drocap_ros.background import Background
from drocap_ros.geometry.rotations import exp_so3, log_so3
from drocap_ros.reconstruction.camera.fusion import FusedTelemetry, fuse_telemetry, joints_by_camera
from drocap_ros.reconstruction.common.refusal import Refusal
from drocap_ros.reconstruction.world.world_model import WorldConfig
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks

FPS = 12.0
FRAMES = 90


@pytest.fixture(scope="module")
def true() -> Scene:
    return seen(*orbit(FRAMES, FPS), points_of(np.random.default_rng(2), 160), FPS)


def tracks(true: Scene, rotation: np.ndarray | None = None, position: np.ndarray | None = None) -> Tracks:
    """The scene's points with telemetry, exact unless other is given."""
    noise = np.random.default_rng(3).normal(0.0, 0.3, true.point.shape)
    return Tracks(
        keypoints=np.full((len(true.position), 15, 2), 300.0),
        joints=BODY_15.joints,
        stamp_ns=np.round(np.arange(len(true.position)) * 1e9 / FPS).astype(np.int64),
        image_size=SIZE,
        camera_rotation=true.rotation if rotation is None else rotation,
        camera_position=true.position if position is None else position,
        camera_matrix=MATRIX,
        background=Background(
            true.frame.astype(np.int32), true.track.astype(np.int64), (true.point + noise).astype(np.float32)
        ),
    )


def fused(given: Tracks) -> FusedTelemetry:
    found = fuse_telemetry(given, WorldConfig())
    assert isinstance(found, FusedTelemetry)
    return found


def motion_errors(true: Scene, of: Tracks, lag: int = 36) -> tuple[float, float]:
    """RMS error of the camera's turn (degrees) and way (m, in its axes) within 3 s."""
    turns = [rotation[lag:] @ np.swapaxes(rotation[:-lag], 1, 2) for rotation in (true.rotation, of.camera_rotation)]
    ways = [
        np.einsum("fij,fj->fi", rotation[:-lag], position[lag:] - position[:-lag])
        for rotation, position in ((true.rotation, true.position), (of.camera_rotation, of.camera_position))
    ]
    turned = np.degrees(log_so3(turns[0] @ np.swapaxes(turns[1], 1, 2)))
    return tuple(float(np.sqrt(np.square(error).sum(axis=1).mean())) for error in (turned, ways[0] - ways[1]))


def wave(frames: int, size: float) -> np.ndarray:
    """(F, 3) errors that change within a minute."""
    return size * np.sin(np.arange(frames)[:, None] / FPS * [0.11, 0.15, 0.08] + [0.0, 1.0, 2.0])


def test_points_find_misalignment_and_wander(true: Scene) -> None:
    rotation = exp_so3(np.deg2rad([0.8, -2.5, 0.6]) + np.deg2rad(wave(FRAMES, 1.0))) @ true.rotation
    reported = tracks(true, rotation, true.position + wave(FRAMES, 0.5))
    corrected = fused(reported).tracks
    before, after = motion_errors(true, reported), motion_errors(true, corrected)
    assert after[0] < 0.1
    assert after[0] < 0.3 * before[0]
    assert after[1] < 0.1
    assert after[1] < 0.3 * before[1]


def test_a_wrong_yaw_is_found_inside_its_own_interval(true: Scene) -> None:
    # Errors are constant in camera axes; this camera tilts by some degrees, and a yaw about the vertical is not quite.
    north = exp_so3(np.array([0.0, 0.0, np.deg2rad(-1.0)]))
    measured = fused(tracks(true, true.rotation @ north)).measured
    found, std = measured["misalignment_deg"][1], measured["misalignment_std_deg"][1]
    assert abs(found) == pytest.approx(1.0, abs=0.3)
    assert abs(abs(found) - 1.0) < 2.5 * std
    assert std < 0.5


def test_a_frozen_part_of_a_log_is_refused_as_without_points(true: Scene) -> None:
    rotation, position = true.rotation.copy(), true.position.copy()
    rotation[30:60], position[30:60] = rotation[30], position[30]
    assert isinstance(fuse_telemetry(tracks(true, rotation, position), WorldConfig()), Refusal)


def test_late_stamps_are_found(true: Scene) -> None:
    late = 1  # frames, 83 ms
    long = seen(*orbit(FRAMES + late, FPS), points_of(np.random.default_rng(2), 160), FPS)
    keep = long.frame >= late
    seen_later = Scene(
        long.rotation[late:], long.position[late:], long.frame[keep] - late, long.track[keep], long.point[keep], FPS
    )
    measured = fused(tracks(seen_later, long.rotation[:-late], long.position[:-late])).measured
    for name in ("attitude", "position"):
        error = abs(abs(measured[f"{name}_latency_s"]) - late / FPS)
        assert error < 0.02, name
        assert error < 2.5 * measured[f"{name}_latency_std_s"] + 0.005, name


def test_exact_telemetry_stays_exact(true: Scene) -> None:
    turned, moved = motion_errors(true, fused(tracks(true)).tracks)
    assert turned < 0.03
    assert moved < 0.02


def test_the_place_of_a_receiver_is_as_unknown_as_its_wander_whatever_the_noise_of_points(true: Scene) -> None:
    rotation = exp_so3(np.deg2rad(wave(FRAMES, 1.0))) @ true.rotation
    given = tracks(true, rotation, true.position + wave(FRAMES, 0.5))
    points = given.background
    assert points is not None
    places = []
    for noise_px in (0.1, 1.0):
        noise = np.random.default_rng(3).normal(0.0, noise_px, true.point.shape)
        found = fused(replace(given, background=replace(points, point=(true.point + noise).astype(np.float32))))
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
    one = fused(tracks(true, rotation, true.position + wave(FRAMES, 0.2))).tracks
    other = fused(tracks(true, rotation @ north.T, (true.position + wave(FRAMES, 0.2)) @ north.T + origin)).tracks
    np.testing.assert_allclose(other.camera_rotation, one.camera_rotation @ north.T, atol=1e-5)
    np.testing.assert_allclose(other.camera_position, one.camera_position @ north.T + origin, atol=5e-3)


def test_without_points_or_telemetry_nothing_is_measured(true: Scene) -> None:
    given = tracks(true)
    few = Background(given.background.frame[:5], given.background.track[:5], given.background.point[:5])
    for changed in (
        {"background": None},
        {"background": few},
        {"camera_position": None},
        {"camera_rotation": None},
        {"camera_matrix": None},
    ):
        assert fuse_telemetry(replace(given, **changed), WorldConfig()) is None


def test_joints_move_as_the_camera_that_sees_them() -> None:
    rng = np.random.default_rng(0)
    rotation, position = exp_so3(rng.normal(size=(4, 3))), rng.normal(size=(4, 3))
    joints = rng.normal(size=(4, 5, 3)) + np.array([0.0, 6.0, 0.0])
    local = (joints - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    change = 1e-6 * rng.normal(size=(4, 6))
    moved = local @ (exp_so3(change[:, 3:]) @ rotation) + (position + change[:, :3])[:, None]
    expected = joints_by_camera(joints, rotation, position) @ change[:, None, :, None]
    np.testing.assert_allclose(moved - joints, expected[..., 0], atol=1e-10)
