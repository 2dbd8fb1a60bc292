"""Poses interpolated in time."""

from __future__ import annotations

import numpy as np
from walking import make_walk, stamps

from drocap_ros.evaluation.metrics import pa_mpjpe
from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.geometry.interpolation import fill_frames


def test_interpolated_poses_keep_their_size_while_the_body_turns() -> None:
    walk = make_walk(60, speed_deg_s=60.0)
    broken = walk.in_camera.copy()
    broken[20:40] = np.nan
    filled = fill_frames(stamps(60), broken)
    np.testing.assert_array_equal(filled[:20], walk.in_camera[:20])
    torso = limb_lengths(filled)[:, 4]  # the line of the hips
    np.testing.assert_allclose(torso, 0.18, atol=0.005)
    assert pa_mpjpe(filled, 1000.0 * walk.in_camera)[20:40].mean() < 140.0
