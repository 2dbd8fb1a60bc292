"""Keypoints2D: slicing and derived arrays."""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import Keypoints2D

XY = np.arange(24.0).reshape(4, 3, 2)
XY[1, 2, 0] = np.nan


def test_slices_cover_every_array_and_absent_ones_stay_absent() -> None:
    whole = Keypoints2D(XY, np.full((4, 3), 0.5), np.ones((4, 3, 3)))
    part = whole[np.array([True, False, True, False])]
    np.testing.assert_array_equal(part.xy, XY[::2])
    assert (len(part), part.weights.shape, part.covariance.shape) == (2, (2, 3), (2, 3, 3))
    assert Keypoints2D(XY)[1:].confidence is None
    assert Keypoints2D(XY)[1:].covariance is None


def test_weights_are_zero_where_not_seen_and_one_without_confidence() -> None:
    seen = np.ones((4, 3))
    seen[1, 2] = 0.0
    np.testing.assert_array_equal(Keypoints2D(XY).weights, seen)
    np.testing.assert_array_equal(Keypoints2D(XY, np.full((4, 3), np.nan)).weights, 0.0)
    np.testing.assert_array_equal(Keypoints2D(XY, np.full((4, 3), 0.5)).weights, 0.5 * seen)
