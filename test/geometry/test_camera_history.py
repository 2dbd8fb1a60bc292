"""The camera's reported poses on their way into a live window."""

from __future__ import annotations

import numpy as np
import pytest
from telemetry_stream import orbit

from drocap_ros.geometry.camera_history import CameraHistory

S = 10**9
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
MATRIX = np.array([[900.0, 0, 640.0], [0, 900.0, 360.0], [0, 0, 1.0]])


def scaled(factor: float) -> np.ndarray:
    return MATRIX * np.array([[factor], [factor], [1.0]])


def at(*seconds: float) -> np.ndarray:
    return np.array([round(s * S) for s in seconds], np.int64)


def filled(*seconds: float) -> CameraHistory:
    history = CameraHistory(12.0)
    history.add_matrix(0, MATRIX)
    for s in seconds:
        history.add_pose(round(s * S), np.array([s, 0.0, 5.0]), LEVEL)
    return history


def test_poses_are_those_of_the_images() -> None:
    flown = orbit(2.0)
    camera = flown.history().along(flown.stamp_ns)
    assert camera is not None
    np.testing.assert_allclose(camera.rotation, flown.rotation, atol=1e-9)
    np.testing.assert_allclose(camera.position, flown.position, atol=1e-9)
    assert camera.known.all()
    assert camera.focal_px == pytest.approx(flown.matrix[0, 0])


def test_poses_are_interpolated_between_reports_and_unknown_elsewhere() -> None:
    camera = filled(0.0, 1.0, 4.0).along(at(-1.0, 0.5, 1.05, 2.0, 4.0, 4.09, 4.2))
    assert camera is not None
    # 3 s without a report are not bridged; the first and the last one hold for 0.1 s.
    np.testing.assert_array_equal(camera.known, [False, True, False, False, True, True, False])
    assert camera.position[1, 0] == pytest.approx(0.5)


def test_without_a_calibration_there_is_no_camera_and_without_a_pose_only_its_lens() -> None:
    assert CameraHistory(12.0).along(at(1.0)) is None
    bare = CameraHistory(12.0)
    bare.add_pose(S, np.zeros(3), LEVEL)
    for unusable in (np.full((3, 3), np.nan), MATRIX / 1280.0, MATRIX.T):
        bare.add_matrix(S, unusable)
    assert bare.along(at(1.0)) is None
    blind = CameraHistory(12.0)
    blind.add_matrix(0, MATRIX)
    blind.add_pose(S, np.array([1.0, np.nan, 0.0]), LEVEL)
    blind.add_pose(S, np.zeros(3), np.full(4, np.nan))
    blind.add_pose(S, np.zeros(3), np.zeros(4))
    lens = blind.along(at(1.0, 2.0))
    assert lens is not None
    assert lens.focal_px == MATRIX[0, 0]
    assert not lens.known.any()
    assert blind.newest_ns == 0


def test_a_late_report_is_left_out_and_a_loop_restarts() -> None:
    history = filled(10.0, 10.5)
    history.add_pose(round(10.2 * S), np.array([99.0, 0.0, 0.0]), LEVEL)
    camera = history.along(at(10.2))
    assert camera is not None
    assert camera.position[0, 0] == pytest.approx(10.2)
    history.add_pose(round(2.0 * S), np.array([2.0, 0.0, 0.0]), LEVEL)
    assert history.newest_ns == 2 * S
    camera = history.along(at(2.0, 10.2))
    assert camera is not None
    np.testing.assert_array_equal(camera.known, [True, False])


def test_calibration_of_another_image_size_is_not_used() -> None:
    history = filled(0.0, 1.0)
    assert history.along(at(0.5), (1280, 720)) is not None  # its size is not stated
    history = CameraHistory(12.0)
    history.add_pose(S, np.zeros(3), LEVEL)
    history.add_matrix(S, MATRIX, (640, 480))
    assert history.along(at(1.0), (1280, 720)) is None
    assert history.uncalibrated((1280, 720)) == "camera_info is for images of 640x480 px, pose2d of 1280x720"
    history.add_matrix(2 * S, MATRIX, (1280, 720))
    camera = history.along(at(1.0), (1280, 720))
    assert camera is not None
    assert camera.focal_px == MATRIX[0, 0]
    assert history.uncalibrated((1280, 720)) == ""


def test_poses_without_a_calibration_are_named() -> None:
    history = CameraHistory(2.0)
    assert history.uncalibrated((1280, 720)) == ""  # no telemetry either
    history.add_pose(S, np.zeros(3), LEVEL)
    history.add_matrix(S, np.full((3, 3), np.nan))
    assert history.uncalibrated((1280, 720)).startswith("no usable camera_info has arrived")


def test_memory_is_bounded_and_a_window_stays_whole() -> None:
    history = CameraHistory(2.0)
    history.add_matrix(0, MATRIX)
    for i in range(100_000):
        history.add_pose(i * S // 50, np.array([i / 50.0, 0.0, 0.0]), LEVEL)
        if i % 1000 == 0:
            history.add_matrix(i * S // 50, scaled(1.0 + i))
    assert len(history._stamps) < 500
    assert len(history._lenses) <= 20
    end = 99_999 / 50
    camera = history.along(at(end - 2.0, end - 1.0, end))
    assert camera is not None
    assert camera.known.all()


def test_the_calibration_is_that_of_the_image() -> None:
    history = filled(0.0, 1.0, 2.0)
    history.add_matrix(round(1.5 * S), scaled(2.0))
    focal = [history.along(at(s)).focal_px for s in (0.0, 1.4, 1.6)]  # type: ignore[union-attr]
    assert focal == [900.0, 900.0, 1800.0]
