"""The default method: its cost's derivatives, the signs, and what must not change the result."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.evaluation.protocol import PX_PER_MM, orbit_rotations, orbit_view, protocol_sequences
from drocap_ros.geometry.bones import bone_lengths
from drocap_ros.keypoints import Keypoints2D
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
from drocap_ros.reconstruction.lifted.depth_signs import depth_signs
from drocap_ros.reconstruction.lifted.even_frames import even_slots
from drocap_ros.reconstruction.lifted.lifted_config import LiftedConfig
from drocap_ros.reconstruction.lifted.method import solve_even_window
from drocap_ros.reconstruction.reconstruct import reconstruct
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import Tracks


def problem(frames: int = 6, seed: int = 0) -> tuple[AdjustmentProblem, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    basis, precision = zoom_model(frames, 3.0, 0.05)
    joints = rng.normal(0, 300, (frames, 15, 3))
    p = AdjustmentProblem(
        keypoints=joints[..., :2] + rng.normal(0, 10, (frames, 15, 2)),
        weight=rng.uniform(0, 0.1, (frames, 15)) * (rng.random((frames, 15)) < 0.8),
        prior=joints + rng.normal(0, 30, joints.shape),
        prior_weight_xy=rng.uniform(0, 0.01, (frames, 15)),
        prior_weight_z=rng.uniform(0, 0.05, (frames, 15)),
        acceleration_weight=1e-3,
        zoom_basis=basis,
        zoom_precision=precision,
    )
    return p, joints, span_lengths(joints).mean(axis=0)


def test_gradient_of_every_term_is_that_of_its_cost():
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


def test_normal_equations_are_those_of_the_linearised_residuals():
    # Without the robust terms the Gauss-Newton matrix is J^T J: check it against the change of the gradient where
    # the bones' directions stay put, along the bones themselves.
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
    whole = np.block([[dense, border.T], [border, corner]])
    assert np.linalg.eigvalsh(whole).min() > -1e-9 * np.abs(whole).max()
    # The cost of lengths and zoom is (nearly) quadratic: the corner is its second derivative.
    _, before = _gradient(p, r)
    for k in range(len(SPANS)):
        step = np.zeros(len(lengths))
        step[k] = 1e-3
        _, after = _gradient(p, _Residuals(p, joints, lengths + step, zooms))
        np.testing.assert_allclose((after - before)[: len(SPANS)] / 1e-3, corner[: len(SPANS), k], rtol=1e-6, atol=1e-9)


def test_cost_never_rises_and_the_solve_says_why_it_stopped():
    p, joints, lengths = problem(frames=20)
    start = joints + np.random.default_rng(3).normal(0, 50, joints.shape)
    costs = [sum(adjust(p, start, lengths, k, tolerance=0.0).cost_terms.values()) for k in range(6)]
    assert all(b <= a for a, b in pairwise(costs))
    assert adjust(p, start, lengths, 500).stop_reason in ("converged", "no descent")
    assert adjust(p, start, lengths, 1, tolerance=0.0).stop_reason == "iterations"


def test_signs_follow_a_bone_through_the_image_plane_and_not_an_outlier():
    angle = np.linspace(-1.2, 1.2, 61)
    depth = 300 * np.sin(angle)[:, None]
    opinion = depth.copy()
    opinion[12:18] *= -1  # the lifter is wrong for six frames
    signs = depth_signs(np.abs(depth), opinion, np.full(depth.shape, 200.0), 60.0, 25.0)
    np.testing.assert_array_equal(signs[np.abs(depth) > 1], np.sign(depth)[np.abs(depth) > 1])


def test_signs_bounce_where_the_bone_touches_the_image_plane_without_crossing():
    depth = 0.2 * np.square(np.arange(-30, 31.0))[:, None]
    signs = depth_signs(depth, np.abs(depth) * 0.1, np.full(depth.shape, 60.0), 60.0, 25.0)
    assert (signs[np.abs(depth) > 1] == 1).all()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_signs_of_short_sequences_are_the_opinion(frames):
    signs = depth_signs(np.full((frames, 2), 100.0), np.tile([90.0, -90.0], (frames, 1)), np.ones((frames, 2)), 60, 25)
    np.testing.assert_array_equal(signs, np.tile([1.0, -1.0], (frames, 1)))


def sway(frames: int) -> np.ndarray:
    """(F, 15, 3) mm, z up: a person who sways and swings arms and legs, all limbs of constant length."""
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
        joints[f"{side}shoulder"] = joints["neck"] + np.array([180.0 * x, -10.0, -90.0])
        joints[f"{side}elbow"] = limb(joints[f"{side}shoulder"], 290.0, 0.6 * np.sin(3 * t + phase + 3), 0.3 * x)
        joints[f"{side}wrist"] = limb(joints[f"{side}elbow"], 250.0, 0.6 * np.sin(3 * t + phase + 3) + 0.7, 0.2 * x)
    return np.stack([joints[name] for name in BODY_15.joints], axis=1)


@pytest.fixture(scope="module")
def view():
    return orbit_view(sway(120), 25.0)


@pytest.fixture(scope="module")
def plain(view):
    return solve_even_window(Keypoints2D(view.tracks.keypoints))


def error(result, view) -> float:
    return float(pa_mpjpe(result.joints / PX_PER_MM, view.truth).mean())


def test_a_person_of_rigid_limbs_is_found(view, plain):
    assert error(plain, view) < 35.0
    limbs = np.array([1, 2, 4, 5, 9, 10, 12, 13])
    found, true = bone_lengths(plain.joints)[:, limbs].mean(axis=0), bone_lengths(view.truth)[:, limbs].mean(axis=0)
    np.testing.assert_allclose(found / PX_PER_MM, true, rtol=0.04)
    assert plain.steps[1] > 0
    assert plain.stop_reason in ("converged", "iterations")


def test_image_scale_and_place_do_not_matter(view, plain):
    moved = solve_even_window(Keypoints2D(2.5 * view.tracks.keypoints + np.array([100.0, -300.0])))
    expected = 2.5 * plain.joints + np.array([100.0, -300.0, 0.0])
    np.testing.assert_allclose(moved.joints, expected, atol=2.0)


def test_the_azimuth_of_the_world_does_not_matter(view, plain):
    turned = sway(120) @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # A world turned under an orbit that starts as far turned gives the same pictures, so compare errors only.
    other = orbit_view(turned, 25.0)
    assert error(solve_even_window(Keypoints2D(other.tracks.keypoints)), other) < 40.0


def test_the_same_input_gives_the_same_bits(view, plain):
    again = solve_even_window(Keypoints2D(view.tracks.keypoints.copy()))
    assert np.array_equal(again.joints, plain.joints)


def test_gross_outliers_without_confidences_do_not_drag_the_shape(view, plain):
    rng = np.random.default_rng(0)
    points = view.tracks.keypoints.copy()
    gross = rng.random(points.shape[:2]) < 0.05
    points[gross] += rng.uniform(-300, 300, (gross.sum(), 2)) * PX_PER_MM
    spoiled = solve_even_window(Keypoints2D(points))
    assert error(spoiled, view) < error(plain, view) + 6.0


def test_missing_joints_are_filled_in(view, plain):
    points = view.tracks.keypoints.copy()
    points[30:50, BODY_15.index("rwrist")] = np.nan
    points[70] = np.nan
    filled = solve_even_window(Keypoints2D(points))
    assert np.isfinite(filled.joints).all()
    assert error(filled, view) < error(plain, view) + 10.0
    never = view.tracks.keypoints.copy()
    never[:, BODY_15.index("lankle")] = np.nan
    assert np.isfinite(solve_even_window(Keypoints2D(never)).joints).all()


def test_a_person_who_comes_nearer_keeps_the_shape(view, plain):
    zoom = np.linspace(0.8, 1.2, 120)[:, None, None]
    points = view.tracks.keypoints
    centre = points.mean(axis=1, keepdims=True)
    nearer = solve_even_window(Keypoints2D(centre + (points - centre) * zoom))
    assert error(nearer, view) < error(plain, view) + 10.0


@pytest.mark.parametrize("frames", [1, 2, 3, 5])
def test_short_windows_have_an_answer(view, frames):
    result = solve_even_window(Keypoints2D(view.tracks.keypoints[:frames]))
    assert result.joints.shape == (frames, 15, 3)
    assert np.isfinite(result.joints).all()


def test_nothing_seen_is_refused():
    with pytest.raises(InputError, match="at least one seen joint"):
        solve_even_window(Keypoints2D(np.full((5, 15, 2), np.nan)))
    with pytest.raises(InputError, match="depth_weight"):
        LiftedConfig(depth_weight=-1.0)


def test_dropped_frames_get_their_place_back():
    slot, fps = even_slots((np.array([0, 1, 2, 5, 6, 7]) * 40_000_000).astype(np.int64))
    np.testing.assert_array_equal(slot, [0, 1, 2, 5, 6, 7])
    assert fps == pytest.approx(25.0)
    # A long pause does not blow the grid up.
    slot, _ = even_slots(np.array([0, 40_000_000, 80_000_000, 3_600_000_000_000], dtype=np.int64))
    assert slot[-1] < 40


def test_a_near_camera_of_known_lens_is_no_worse_than_a_far_one(shared):
    """A camera 6 m away that looks at a fixed point while the person walks about: size and perspective change."""
    (sequence,) = protocol_sequences(shared / "mocap" / "dev", limit=1)
    x = sequence.x
    rotation = orbit_rotations(len(x), 25.0)
    position = x[:, 0].mean(axis=0) - 6000.0 * rotation[:, 2]
    truth = np.einsum("fij,fpj->fpi", rotation, x - position[:, None])
    focal_px = 1000.0
    keypoints = focal_px * truth[..., :2] / truth[..., 2:] + np.array([640.0, 512.0])
    matrix = np.array([[focal_px, 0.0, 640.0], [0.0, focal_px, 512.0], [0.0, 0.0, 1.0]])
    stamp_ns = np.round(np.arange(len(x)) * 1e9 / 24.0).astype(np.int64)
    tracks = Tracks(keypoints, BODY_15.joints, stamp_ns, (1280, 1024))

    def found(tracks: Tracks) -> float:
        return 1000.0 * float(pa_mpjpe(reconstruct(tracks).joints3d, truth / 1000.0).mean())

    blind, known = found(tracks), found(replace(tracks, camera_matrix=matrix))
    assert known < blind < 30.0
    assert known < 20.0


def test_unseen_people_clean_and_noisy(shared):
    sequences = protocol_sequences(shared / "mocap" / "dev", limit=3)
    for noisy, most in ((False, 25.0), (True, 33.0)):
        views = [orbit_view(q.x, 25.0, noisy=noisy) for q in sequences]
        found = [error(solve_even_window(Keypoints2D(v.tracks.keypoints)), v) for v in views]
        assert np.mean(found) < most
