"""The E-step against its properties."""

from __future__ import annotations

import numpy as np

from drocap_ros.reconstruction.paper.single_view import expected_information

ONE = np.array([1.0, 0.0, 1.0])


def test_information_falls_with_the_distance_from_the_model() -> None:
    projected = np.array([[[0.0, 0.0], [0.1, 0.0], [1.5, 0.0]]])
    information = expected_information(np.zeros((1, 3, 2)), np.tile(ONE, (1, 3, 1)), projected, 0.1)
    assert information[0, 0, 0] > 0.99
    assert information[0, 0, 0] > information[0, 1, 0] > 0.9
    assert information[0, 2, 0] < 1e-6


def test_a_missing_joint_stays_missing() -> None:
    missing = np.zeros((1, 1, 3))
    assert np.all(expected_information(np.zeros((1, 1, 2)), missing, np.zeros((1, 1, 2)), 0.1) == 0.0)
