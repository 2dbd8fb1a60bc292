"""Covariances of poses about their pelvis."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import exp_so3, unpack_covariance
from drocap_ros.reconstruction.common.poses import Spread, packed


def test_poses_of_other_size_and_lean_have_the_covariance_that_is_told():
    rng = np.random.default_rng(0)
    joints = np.concatenate([np.zeros((1, 1, 3)), rng.normal(0, 0.4, (1, 5, 3))], axis=1)
    sigma = rng.uniform(0.01, 0.05, (1, 6, 2))
    spread = Spread(1.3, 2.0, size=0.03, lean=0.06)
    draws = 20_000
    turn = exp_so3(np.pad(rng.normal(0, spread.lean, (draws, 2)), ((0, 0), (0, 1))))
    size = 1 + rng.normal(0, spread.size, (draws, 1, 1))
    own = rng.standard_normal((draws, 6, 3)) * sigma[..., [0, 0, 1]] * (1.3, 1.3, 2.0)
    error = size * (joints @ turn) + own - joints
    drawn = np.einsum("npi,npj->pij", error, error) / draws
    told = spread.covariance(joints + 5.0, sigma)[0]
    np.testing.assert_allclose(told, drawn, atol=0.05 * np.abs(drawn).max())
    np.testing.assert_array_equal(unpack_covariance(packed(told)), told)


def test_a_method_that_errs_joint_by_joint_has_axes_along_and_across_the_ray():
    sigma = np.full((2, 3, 2), (0.02, 0.05))
    told = Spread().covariance(np.ones((2, 3, 3)), sigma)
    np.testing.assert_allclose(told, np.broadcast_to(np.diag([0.0004, 0.0004, 0.0025]), told.shape))
