"""Positions that are reported in steps, and the path without them."""

from __future__ import annotations

import numpy as np
import pytest
from walking import make_walk, stamps

from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.interpolation import fill_frames, usual_step, without_steps
from drocap_ros.recording.telemetry.camera_poses import camera_poses
from drocap_ros.recording.telemetry.log import VehicleTrack

FPS = 30.0
STAMPS = np.round(np.arange(360) * 1e9 / FPS).astype(np.int64)
TIME = STAMPS * 1e-9


def orbit(speed_deg_s: float = 19.0) -> np.ndarray:
    """(F, 3) m: 6 m from the person."""
    bearing = 0.3 + np.deg2rad(speed_deg_s) * TIME
    return np.column_stack([6.0 * np.cos(bearing), 6.0 * np.sin(bearing), np.full(len(TIME), 2.5)])


def drift() -> np.ndarray:
    """(F, 3) m: a hover that drifts by decimetres."""
    return np.column_stack([0.2 * np.sin(0.5 * TIME), 0.15 * np.cos(0.7 * TIME), 2.5 + 0.2 * np.sin(0.6 * TIME)])


def spread(path: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(3,) m, of the errors: a constant one does not matter."""
    return (path - truth).std(axis=0)


@pytest.mark.parametrize("kind", ["orbit", "drift", "walk", "white", "stopped", "rests"])
def test_positions_without_steps_stay_as_they_are(kind: str) -> None:
    rng, path = np.random.default_rng(0), orbit()
    if kind == "drift":
        path = drift()
    elif kind == "walk":
        path = path + 0.015 * np.cumsum(rng.standard_normal(path.shape), axis=0)
    elif kind == "white":
        path = path + 0.02 * rng.standard_normal(path.shape)
    elif kind == "stopped":
        path = path[np.minimum(np.arange(len(path)), 200)]
    elif kind == "rests":
        path = np.tile(path[0], (len(path), 1))
    np.testing.assert_array_equal(without_steps(path, STAMPS), path)


@pytest.mark.parametrize("speed_deg_s", [19.0, 25.0])
def test_a_rounded_orbit_becomes_smooth(speed_deg_s: float) -> None:
    truth = orbit(speed_deg_s)
    grid = np.array([0.08, 0.11, 0.1])
    raw = np.round(truth / grid) * grid
    path = without_steps(raw, STAMPS)
    moved, true = np.diff(path, axis=0)[:, :2], np.diff(truth, axis=0)[:, :2]
    assert np.abs(moved - true).max() < 0.025 < 0.075 < np.abs(np.diff(raw, axis=0)[:, :2] - true).max()
    assert (moved * true).sum() / (true * true).sum() == pytest.approx(1.0, abs=0.02), "as long as the true one"


def test_a_rounded_hover_does_not_jump() -> None:
    truth = drift()
    path = without_steps(np.round(truth / 0.1) * 0.1, STAMPS)
    assert spread(path, truth).max() < 0.06
    assert np.abs(np.diff(path - truth, axis=0)).max() < 0.01


def test_a_held_report_was_true_when_it_came() -> None:
    truth = orbit()
    raw = truth[np.arange(len(truth)) // 6 * 6]
    path = without_steps(raw, STAMPS)
    inner = slice(12, -12)
    assert np.abs(path - truth)[inner].max() < 0.05
    assert np.abs(raw - truth)[inner].max() > 0.3


def test_a_jump_of_a_rounded_log_stays() -> None:
    raw = np.round(drift() / 0.1) * 0.1
    raw[200:, 0] += 5.0
    np.testing.assert_array_equal(without_steps(raw, STAMPS)[:, 0], raw[:, 0])


def test_steps_of_a_log_are_taken_off_before_its_interpolation() -> None:
    """Images between the states see parts of the steps, which no longer stand alone."""
    truth, nothing = orbit(), np.full((len(STAMPS), 4), np.nan)
    raw = np.round(truth / 0.11) * 0.11
    later = STAMPS[30:300] + np.round(np.linspace(0, 3e7, 270)).astype(np.int64)
    found = camera_poses(VehicleTrack(STAMPS, raw, nothing, nothing), later).position
    exact = camera_poses(VehicleTrack(STAMPS, truth, nothing, nothing), later).position
    assert found is not None
    assert exact is not None
    assert np.abs(np.diff(found - exact, axis=0)).max() < 0.02


def test_interpolated_poses_keep_their_size_while_the_body_turns() -> None:
    walk = make_walk(60, speed_deg_s=60.0)
    broken = walk.in_camera.copy()
    broken[20:40] = np.nan
    filled = fill_frames(stamps(60), broken)
    np.testing.assert_array_equal(filled[:20], walk.in_camera[:20])
    torso = limb_lengths(filled)[:, 4]  # the line of the hips
    np.testing.assert_allclose(torso, 0.18, atol=0.005)
    assert pa_mpjpe(filled, 1000.0 * walk.in_camera)[20:40].mean() < 140.0


def test_the_usual_step_is_that_of_the_camera_in_coarse_stamps_with_a_pause_and_lost_frames() -> None:
    for rate_hz in (24.0, 30.0, 60.0, 120.0):
        times = np.round(1000.0 * np.delete(np.arange(600), [7, 90, 91, 300]) / rate_hz)
        times[400:] += 3000.0
        assert 1000.0 / usual_step(times) == pytest.approx(rate_hz, rel=2e-3)
    assert usual_step(np.array([0.0, 1.0, 101.0])) in (1.0, 100.0)
