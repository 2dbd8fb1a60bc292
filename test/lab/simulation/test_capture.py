import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.simulation.pinhole import pinhole_matrix, project, to_camera
from drocap_ros.skeleton import BODY_15
from lab.simulation.capture import SimulationConfig, simulate_capture
from lab.simulation.keypoint_errors import noisy_keypoints, occlusion
from lab.simulation.orbit import look_at, orbit_camera


def test_camera_points_at_its_target_and_is_level():
    rng = np.random.default_rng(1)
    position, target = rng.normal(size=(2, 50, 3)) * 5
    rotation = look_at(position, target)
    assert np.allclose(rotation @ np.swapaxes(rotation, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotation), 1)
    seen = to_camera(target[:, None], rotation, position)[:, 0]
    assert np.allclose(seen[:, :2], 0, atol=1e-9)
    assert (seen[:, 2] > 0).all()
    assert np.allclose(rotation[:, 0, 2], 0)  # image x is horizontal
    assert (rotation[:, 1, 2] < 0).all()  # image y points down


def test_camera_straight_above_its_target_has_a_rotation():
    rotation = look_at(np.array([[0.0, 0.0, 5.0]]), np.zeros((1, 3)))
    assert np.allclose(rotation[0] @ rotation[0].T, np.eye(3))
    assert np.isclose(np.linalg.det(rotation[0]), 1)


def test_orbit_has_constant_radius_and_angular_speed():
    t = np.linspace(0, 4, 101)
    centre = np.stack([t, 0.2 * t, np.ones_like(t)], axis=1)
    _, position = orbit_camera(t, centre, 6.0, 3.0, 25.0, start_deg=90)
    away = position - centre
    assert np.allclose(np.linalg.norm(away[:, :2], axis=1), 6.0)
    turned = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert np.isclose(np.rad2deg(turned[-1] - turned[0]), 100.0)
    assert np.allclose(away[0, :2], [0, 6])


def test_projection_equals_its_definition():
    matrix = pinhole_matrix(640, 480, 90.0)
    assert np.isclose(matrix[0, 0], 320.0)
    point = np.array([[[1.0, 0.5, 2.0], [0.0, 0.0, -1.0]]])
    px = project(point, np.eye(3)[None], np.zeros((1, 3)), matrix)
    assert np.allclose(px[0, 0], [319.5 + 160, 239.5 + 80])
    assert np.isnan(px[0, 1]).all()


@pytest.fixture(scope="module")
def capture():
    return simulate_capture(20, 30, seed=11)


def test_keypoints_are_projections_of_the_joints(capture):
    tracks = capture.tracks
    assert tracks.joints == BODY_15.joints
    assert len(tracks) == 600
    px = project(capture.joints3d_world, capture.camera_rotation, capture.camera_position, tracks.camera_matrix)
    assert np.allclose(px, capture.keypoints_exact)
    inside = (px > 0).all(axis=-1) & (px < np.array(tracks.image_size)).all(axis=-1)
    assert inside.mean() > 0.99


def test_noise_outliers_and_misses_have_the_statistics_of_a_detector(capture):
    tracks, obs = capture.tracks, capture.detection
    error = np.linalg.norm(tracks.keypoints - capture.keypoints_exact, axis=2)
    height = np.ptp(capture.keypoints_exact[..., 1], axis=1)[:, None]
    seen = np.isfinite(error)
    clean = seen & ~obs.outlier
    share = np.where(clean, error / height, np.nan)
    assert 0.005 < np.nanmedian(share) < 0.02
    wrist, hip = (np.nanmedian(share[:, BODY_15.index(j)]) for j in ("rwrist", "neck"))
    assert wrist > 1.4 * hip
    hidden = clean & obs.occluded
    assert np.median(share[hidden]) > 1.5 * np.median(share[clean & ~obs.occluded])
    assert 0.01 < obs.outlier.mean() < 0.08
    assert tracks.confidence[obs.outlier].mean() < tracks.confidence[clean].mean() - 0.3
    assert (tracks.confidence[~seen] == 0).all()
    assert 0.005 < (~seen).mean() < 0.05


def test_reported_covariance_is_right_on_average(capture):
    tracks, obs = capture.tracks, capture.detection
    error = tracks.keypoints - capture.keypoints_exact
    clean = np.isfinite(error).all(axis=2) & ~obs.outlier
    xx, xy, yy = np.moveaxis(tracks.covariance[clean], -1, 0)
    ex, ey = error[clean].T
    assert (xx * yy > xy**2).all()
    mahalanobis = (yy * ex**2 - 2 * xy * ex * ey + xx * ey**2) / (xx * yy - xy**2)
    assert 1.6 < mahalanobis.mean() < 2.8  # 2 for a perfect one


def test_noise_free_observation_is_exact():
    config = SimulationConfig(
        noise_scale=0.0, outlier_fraction=0.0, missed_fraction=0.0, attitude_error_deg=0.0, position_error_m=0.0
    )
    capture = simulate_capture(2, 30, 0, config)
    assert np.allclose(capture.tracks.keypoints, capture.keypoints_exact)
    assert np.allclose(capture.tracks.camera_rotation, capture.camera_rotation)
    assert np.array_equal(capture.tracks.camera_position, capture.camera_position)


def test_telemetry_error_has_the_configured_size():
    capture = simulate_capture(60, 10, 5, SimulationConfig(attitude_error_deg=2.0, position_error_m=0.5))
    off = capture.tracks.camera_rotation @ np.swapaxes(capture.camera_rotation, 1, 2)
    angle = np.rad2deg(np.arccos(np.clip((np.trace(off, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 1.0 < np.sqrt(np.mean(angle**2)) < 3.0
    error = np.linalg.norm(capture.tracks.camera_position - capture.camera_position, axis=1)
    assert 0.25 < np.sqrt(np.mean(error**2)) < 0.8


def test_wrist_behind_the_trunk_is_occluded():
    px = np.zeros((1, 15, 2))
    px[0, BODY_15.index("neck")] = [0, -100]
    px[0] += 1000
    for i in range(15):
        if i not in (0, BODY_15.index("neck"), BODY_15.index("rwrist")):
            px[0, i] = [5000 + 300 * i, 0]
    px[0, BODY_15.index("rwrist")] = [1005, 950]
    depth = np.full((1, 15), 5.0)
    depth[0, BODY_15.index("rwrist")] = 5.4
    assert occlusion(px, depth, 1000.0)[0, BODY_15.index("rwrist")]
    depth[0, BODY_15.index("rwrist")] = 4.6
    assert not occlusion(px, depth, 1000.0).any()


def test_joints_outside_the_image_are_missing():
    px = np.full((3, 15, 2), np.nan)
    obs = noisy_keypoints(px, seed=1)
    assert np.isnan(obs.keypoints).all()
    assert (obs.confidence == 0).all()


def test_capture_depends_on_the_seed_alone():
    a, b, c = (simulate_capture(3, 24, s).tracks for s in (3, 3, 4))
    assert np.array_equal(a.keypoints, b.keypoints, equal_nan=True)
    assert np.array_equal(a.camera_rotation, b.camera_rotation)
    assert not np.array_equal(a.keypoints, c.keypoints, equal_nan=True)


@pytest.mark.parametrize(("seconds", "fps"), [(0, 30), (1, 0), (np.nan, 30), (1, np.inf), (36000, 1000)])
def test_lengths_and_rates_out_of_range_are_refused(seconds, fps):
    with pytest.raises(InputError, match="expected above 0"):
        simulate_capture(seconds, fps)


def test_shortest_capture_has_one_image():
    assert len(simulate_capture(0.01, 30).tracks) == 1
