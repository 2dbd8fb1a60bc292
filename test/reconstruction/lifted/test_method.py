"""The default method: accuracy, invariances, short and damaged input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.alignment import bone_lengths
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.lifted.method import solve_even_window
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_15, BODY_17
from drocap_ros.tracks import Tracks
from lab.studies.protocol import PX_PER_MM, orbit_rotations, orbit_view, protocol_sequences


def sway(frames: int) -> np.ndarray:
    """(F, 17, 3) mm, z up: a person who sways and swings arms and legs, all limbs of constant length."""
    t = np.arange(frames) / 24.0

    def limb(parent: np.ndarray, length: float, swing: np.ndarray, spread: float) -> np.ndarray:
        direction = np.stack([np.sin(spread) * np.ones(frames), np.sin(swing), -np.cos(swing)], axis=-1)
        return parent + length * direction / np.linalg.norm(direction, axis=-1, keepdims=True)

    joints = {"pelvis": np.zeros((frames, 3))}
    joints["neck"] = joints["pelvis"] + np.array([0.0, 30.0, 560.0])
    joints["head"] = joints["neck"] + np.array([0.0, 20.0, 130.0])
    for side, x in (("r", 1.0), ("l", -1.0)):
        phase = 0.0 if side == "r" else np.pi
        joints[f"{side}hip"] = joints["pelvis"] + np.array([95.0 * x, 0.0, -20.0])
        joints[f"{side}knee"] = limb(joints[f"{side}hip"], 430.0, 0.5 * np.sin(3 * t + phase), 0.05 * x)
        joints[f"{side}ankle"] = limb(joints[f"{side}knee"], 410.0, 0.5 * np.sin(3 * t + phase) - 0.5, 0.05 * x)
        joints[f"{side}toe"] = limb(joints[f"{side}ankle"], 190.0, 1.2 + 0.3 * np.sin(3 * t + phase), 0.05 * x)
        joints[f"{side}shoulder"] = joints["neck"] + np.array([180.0 * x, -10.0, -90.0])
        joints[f"{side}elbow"] = limb(joints[f"{side}shoulder"], 290.0, 0.6 * np.sin(3 * t + phase + 3), 0.3 * x)
        joints[f"{side}wrist"] = limb(joints[f"{side}elbow"], 250.0, 0.6 * np.sin(3 * t + phase + 3) + 0.7, 0.2 * x)
    return np.stack([joints[name] for name in BODY_17.joints], axis=1)


@pytest.fixture(scope="module")
def view():
    return orbit_view(sway(120), 25.0)


@pytest.fixture(scope="module")
def plain(view):
    return solve_even_window(Keypoints2D(view.tracks.keypoints))


def error(result, view) -> float:
    return float(pa_mpjpe(result.joints / PX_PER_MM, view.truth).mean())


def test_pose_and_bone_lengths_of_rigid_limbs_are_recovered(view, plain):
    assert error(plain, view) < 35.0
    limbs = np.array([1, 2, 4, 5, 9, 10, 12, 13])
    found, true = bone_lengths(plain.joints)[:, limbs].mean(axis=0), bone_lengths(view.truth)[:, limbs].mean(axis=0)
    np.testing.assert_allclose(found / PX_PER_MM, true, rtol=0.04)
    assert plain.steps[1] > 0
    assert plain.stop_reason in ("converged", "iterations")


def test_result_follows_scale_and_position_in_the_image(view, plain):
    moved = solve_even_window(Keypoints2D(2.5 * view.tracks.keypoints + np.array([100.0, -300.0])))
    expected = 2.5 * plain.joints + np.array([100.0, -300.0, 0.0])
    np.testing.assert_allclose(moved.joints, expected, atol=2.0)


def test_error_is_independent_of_the_azimuth(view, plain):
    turned = sway(120) @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    other = orbit_view(turned, 25.0)
    assert error(solve_even_window(Keypoints2D(other.tracks.keypoints)), other) < 40.0


def test_equal_input_gives_equal_bits(view, plain):
    again = solve_even_window(Keypoints2D(view.tracks.keypoints.copy()))
    assert np.array_equal(again.joints, plain.joints)


def test_gross_outliers_without_confidences_hardly_change_the_error(view, plain):
    rng = np.random.default_rng(0)
    points = view.tracks.keypoints.copy()
    gross = rng.random(points.shape[:2]) < 0.05
    points[gross] += rng.uniform(-300, 300, (gross.sum(), 2)) * PX_PER_MM
    spoiled = solve_even_window(Keypoints2D(points))
    assert error(spoiled, view) < error(plain, view) + 6.0


def test_missing_joints_are_estimated(view, plain):
    points = view.tracks.keypoints.copy()
    points[30:50, BODY_15.index("rwrist")] = np.nan
    points[70] = np.nan
    filled = solve_even_window(Keypoints2D(points))
    assert np.isfinite(filled.joints).all()
    assert error(filled, view) < error(plain, view) + 10.0
    never = view.tracks.keypoints.copy()
    never[:, BODY_15.index("lankle")] = np.nan
    assert np.isfinite(solve_even_window(Keypoints2D(never)).joints).all()


def test_growing_image_size_hardly_changes_the_error(view, plain):
    zoom = np.linspace(0.8, 1.2, 120)[:, None, None]
    points = view.tracks.keypoints
    centre = points.mean(axis=1, keepdims=True)
    nearer = solve_even_window(Keypoints2D(centre + (points - centre) * zoom))
    assert error(nearer, view) < error(plain, view) + 10.0


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_short_windows_give_finite_poses(view, frames):
    result = solve_even_window(Keypoints2D(view.tracks.keypoints[:frames]))
    assert result.joints.shape == (frames, 17, 3)
    assert np.isfinite(result.joints).all()


def test_noise_that_lasts_widens_the_expected_errors(view, plain):
    rng, exact = np.random.default_rng(3), view.tracks.keypoints
    decay, noise_px = np.exp(-1 / 2.4), 12.0 * PX_PER_MM
    fresh = rng.normal(0, noise_px * np.sqrt(1 - decay**2), exact.shape)
    keypoints = exact + lfilter([1.0], [1.0, -decay], fresh, axis=0)
    covariance = np.broadcast_to([noise_px**2, 0.0, noise_px**2], (*exact.shape[:2], 3))
    silent, stated = (solve_even_window(Keypoints2D(keypoints, covariance=c)).sigma for c in (None, covariance))
    # The lifter knows the stated noise; without a covariance the noise that lasts counts on top.
    assert np.median(silent[..., 0] / plain.sigma[..., 0]) > 1.3
    assert np.median(silent[..., 0] / stated[..., 0]) > 1.0


def test_windows_without_a_seen_joint_are_refused():
    with pytest.raises(InputError, match="at least one seen joint"):
        solve_even_window(Keypoints2D(np.full((5, 17, 2), np.nan)))


def test_known_focal_length_lowers_the_error_of_a_near_camera(shared):
    """A camera 6 m from a fixed point while the person walks: size and perspective change."""
    (sequence,) = protocol_sequences(shared / "mocap" / "dev", limit=1)
    x = sequence.x
    rotation = orbit_rotations(len(x), 25.0)
    position = x[:, 0].mean(axis=0) - 6000.0 * rotation[:, 2]
    truth = np.einsum("fij,fpj->fpi", rotation, x - position[:, None])
    focal_px = 1000.0
    keypoints = focal_px * truth[..., :2] / truth[..., 2:] + np.array([640.0, 512.0])
    matrix = np.array([[focal_px, 0.0, 640.0], [0.0, focal_px, 512.0], [0.0, 0.0, 1.0]])
    stamp_ns = np.round(np.arange(len(x)) * 1e9 / 24.0).astype(np.int64)
    tracks = Tracks(keypoints, BODY_17.joints[: x.shape[1]], stamp_ns, (1280, 1024))

    def found(tracks: Tracks) -> float:
        return 1000.0 * float(pa_mpjpe(reconstruct(tracks).joints3d, truth / 1000.0).mean())

    blind, known = found(tracks), found(replace(tracks, camera_matrix=matrix))
    assert known < blind < 30.0
    assert known < 20.0


def test_error_on_held_out_people_stays_low(shared):
    sequences = protocol_sequences(shared / "mocap" / "dev", limit=3)
    for noisy, most in ((False, 25.0), (True, 33.0)):
        views = [orbit_view(q.x, 25.0, noisy=noisy) for q in sequences]
        found = [error(solve_even_window(Keypoints2D(v.tracks.keypoints)), v) for v in views]
        assert np.mean(found) < most
