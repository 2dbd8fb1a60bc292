"""Rotations by identity and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from drocap_ros.geometry import rotations as so3


@pytest.fixture
def vectors() -> np.ndarray:
    rng = np.random.default_rng(1)
    v = rng.normal(size=(200, 3))
    v *= (rng.uniform(0.0, np.pi - 1e-3, 200) / np.linalg.norm(v, axis=1))[:, None]
    v[:5] *= 1e-9
    v[5] = 0.0
    return v


def test_exponential_is_scipys(vectors: np.ndarray) -> None:
    np.testing.assert_allclose(so3.exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)


def test_quaternions_are_scipys_xyzw(vectors: np.ndarray) -> None:
    r = so3.exp_so3(vectors)
    ours, theirs = so3.quaternion_from_matrix(r), Rotation.from_matrix(r).as_quat()
    np.testing.assert_allclose(np.abs(np.sum(ours * theirs, axis=1)), 1.0, atol=1e-12)
    np.testing.assert_allclose(so3.matrix_from_quaternion(3.0 * ours), r, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_quaternion_of_half_turns(axis: int) -> None:
    r = so3.exp_so3(np.pi * np.eye(3)[axis])
    np.testing.assert_allclose(so3.matrix_from_quaternion(so3.quaternion_from_matrix(r)), r, atol=1e-12)


def test_slerp_is_scipys() -> None:
    ends = Rotation.random(2, random_state=3)
    s = np.linspace(0.0, 1.0, 11)
    theirs = Slerp([0.0, 1.0], ends)(s).as_matrix()
    q = ends.as_quat()
    ours = so3.slerp(np.tile(q[0], (11, 1)), np.tile(-q[1], (11, 1)), s)
    np.testing.assert_allclose(so3.matrix_from_quaternion(ours), theirs, atol=1e-12)


def test_one_quaternion_is_turned_as_many_are() -> None:
    rng = np.random.default_rng(4)
    for size in (1.0, 1e-3, 1e-8):  # of the step between the two, down to where the angle counts as none
        a = 3.0 * rng.standard_normal((50, 4))
        b = -a + size * rng.standard_normal((50, 4))
        many = so3.slerp(a, b, np.full(50, 1.3))
        np.testing.assert_allclose([so3.slerp(*pair, 1.3) for pair in zip(a, b, strict=True)], many, atol=1e-15)
        one_by_one = [so3.matrix_from_quaternion(q) for q in a]
        np.testing.assert_allclose(one_by_one, so3.matrix_from_quaternion(a), atol=1e-15)


def test_projection_leaves_rotations_and_is_the_closest() -> None:
    rng = np.random.default_rng(0)
    r = Rotation.random(50, random_state=0).as_matrix()
    np.testing.assert_allclose(so3.project_to_so3(r), r, atol=1e-12)
    m = rng.normal(size=(50, 3, 3))
    p = so3.project_to_so3(m)
    np.testing.assert_allclose(p @ np.swapaxes(p, 1, 2), np.broadcast_to(np.eye(3), p.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(p), 1.0, atol=1e-12)
    others = Rotation.random(500, random_state=1).as_matrix()
    distance = np.linalg.norm(m[:, None] - others[None], axis=(2, 3)).min(1)
    assert np.all(np.linalg.norm(m - p, axis=(1, 2)) <= distance)


def test_completion_is_the_projection_on_the_stiefel_manifold() -> None:
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(30, 2, 3))
    r = so3.complete_rotation(rows)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-12)
    others = Rotation.random(500, random_state=1).as_matrix()[:, :2]
    best = np.linalg.norm(rows[:, None] - others[None], axis=(2, 3)).min(1)
    assert np.all(np.linalg.norm(rows - r[:, :2], axis=(1, 2)) <= best)
