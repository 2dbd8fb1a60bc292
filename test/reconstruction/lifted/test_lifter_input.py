"""Input features of the lifter."""

from __future__ import annotations

import numpy as np

from drocap_ros.keypoints import nanmedian_small
from drocap_ros.reconstruction.lifted.lifter_input import FEATURES, normalise


def test_median_ignores_nan():
    values = np.array([[3.0, np.nan, 1.0, 2.0], [np.nan] * 4, [4.0, 1.0, np.nan, np.nan]])
    np.testing.assert_array_equal(nanmedian_small(values, axis=1), [2.0, np.nan, 2.5])


def test_features_are_centred_scaled_and_zero_where_not_seen():
    points = np.random.default_rng(0).normal(500.0, 60.0, (20, 17, 2))
    points[3, 5] = np.nan
    features, centre, scale = normalise(points, np.ones((20, 17)), np.full(16, 1e-3))
    assert features.shape == (20, FEATURES)
    assert features[3, 10] == features[3, 11] == features[3, 39] == 0.0
    np.testing.assert_allclose(
        features[0, :34].reshape(17, 2) * scale + centre[0], points[0], atol=1e-3 * np.nanmax(points)
    )
