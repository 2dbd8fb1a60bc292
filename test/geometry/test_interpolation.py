"""Poses interpolated in time."""

from __future__ import annotations

import numpy as np
import pytest
from walking import make_walk, stamps

from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.geometry.interpolation import fill_frames, usual_step


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
