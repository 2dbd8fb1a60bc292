"""Adjustment of live windows by the paper's equations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walking import Walk, make_walk, stamps

from drocap_ros.errors import InputError
from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.live.paper_adjustment import adjust_by_equations
from drocap_ros.reconstruction.live.window import Window

FRAMES = 72
WALK = make_walk(FRAMES)
TRUTH = 1000.0 * WALK.in_camera


def window(walk: Walk = WALK, frames: int = FRAMES) -> Window:
    """The walk with initial poses that are too flat by a third in depth."""
    initial = walk.in_camera[:frames] - walk.in_camera[:frames, :1]
    return Window(stamps(frames), Keypoints2D(walk.keypoints[:frames]), initial * (1.0, 1.0, 0.67))


def test_adjusting_improves_the_initial_poses() -> None:
    w = window()
    initial = w.initial_joints.copy()
    w.initial_joints[30:33] = np.nan
    adjusted = adjust_by_equations(w)
    assert pa_mpjpe(adjusted.joints3d, TRUTH).mean() < 0.8 * pa_mpjpe(initial, TRUTH).mean()
    assert limb_lengths(adjusted.joints3d).mean() == pytest.approx(limb_lengths(initial).mean(), rel=0.02)
    assert adjusted.joints3d.shape == (FRAMES, 15, 3)
    assert adjusted.covariance.shape == (FRAMES, 15, 6)
    assert adjusted.reprojection_rms_px.max() < 30.0
    assert adjusted.cost == pytest.approx(sum(adjusted.cost_terms.values()))
    assert adjusted.stop_reason in ("converged", "iterations")
    np.testing.assert_array_equal(adjusted.stamp_ns, stamps(FRAMES))


@pytest.mark.parametrize("frames", [1, 3])
def test_a_short_window_keeps_its_initial_poses(frames: int) -> None:
    w = window(frames=frames)
    adjusted = adjust_by_equations(w)
    np.testing.assert_allclose(adjusted.joints3d, w.initial_joints, atol=1e-9)
    assert adjusted.stop_reason == "too short"


def test_windows_without_initial_poses_are_refused() -> None:
    w = window(frames=9)
    with pytest.raises(InputError, match="a pose in at least one frame"):
        adjust_by_equations(w._replace(initial_joints=np.full((9, 15, 3), np.nan)))
    with pytest.raises(InputError, match="one pose and stamp per image"):
        adjust_by_equations(w._replace(initial_joints=np.zeros((8, 15, 3))))


def test_gross_outliers_hardly_move_the_window() -> None:
    rng = np.random.default_rng(0)
    w = window()
    xy = w.keypoints.xy.copy()
    gross = rng.random(xy.shape[:2]) < 0.04
    xy[gross] += rng.choice([-1.0, 1.0], (int(gross.sum()), 2)) * 150.0
    clean = adjust_by_equations(w)
    hit = adjust_by_equations(w._replace(keypoints=replace(w.keypoints, xy=xy)))
    assert pa_mpjpe(hit.joints3d, TRUTH).mean() < pa_mpjpe(clean.joints3d, TRUTH).mean() + 10.0
