"""Signs of depth over time."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.reconstruction.lifted.window_solver import depth_signs


def test_signs_change_where_a_bone_crosses_the_image_plane_despite_outliers():
    angle = np.linspace(-1.2, 1.2, 61)
    depth = 300 * np.sin(angle)[:, None]
    prior = depth.copy()
    prior[12:18] *= -1  # the lifter is wrong for six frames
    signs = depth_signs(np.abs(depth), prior, np.full(depth.shape, 200.0), 60.0, 25.0)
    np.testing.assert_array_equal(signs[np.abs(depth) > 1], np.sign(depth)[np.abs(depth) > 1])


def test_signs_stay_where_a_bone_touches_the_image_plane():
    depth = 0.2 * np.square(np.arange(-30, 31.0))[:, None]
    signs = depth_signs(depth, np.abs(depth) * 0.1, np.full(depth.shape, 60.0), 60.0, 25.0)
    assert (signs[np.abs(depth) > 1] == 1).all()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_signs_of_short_sequences_are_the_lifters(frames):
    signs = depth_signs(np.full((frames, 2), 100.0), np.tile([90.0, -90.0], (frames, 1)), np.ones((frames, 2)), 60, 25)
    np.testing.assert_array_equal(signs, np.tile([1.0, -1.0], (frames, 1)))
