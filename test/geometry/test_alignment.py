"""Alignment: exact recovery, no reflection; the torso frame follows the body."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from walking import make_walk

from drocap_ros.geometry.alignment import (
    apply_similarity,
    bone_lengths,
    limb_lengths,
    similarity,
    to_torso_frame,
    torso_frame,
)
from drocap_ros.skeleton import BODY_15, RIGID_BONES


def poses(n: int) -> np.ndarray:
    rng = np.random.default_rng(4)
    return rng.normal(size=(n, 15, 3))


def test_a_similarity_is_recovered_exactly() -> None:
    source = poses(20)
    rng = np.random.default_rng(0)
    scale, r, t = rng.uniform(0.1, 9.0, 20), Rotation.random(20, random_state=0).as_matrix(), rng.normal(size=(20, 3))
    target = apply_similarity(source, scale, r, t)
    s2, r2, t2 = similarity(source, target)
    np.testing.assert_allclose(s2, scale, rtol=1e-12)
    np.testing.assert_allclose(r2, r, atol=1e-12)
    np.testing.assert_allclose(t2, t, atol=1e-11)


def test_a_mirror_image_is_not_undone() -> None:
    source = poses(5)
    _, r, _ = similarity(source, source * np.array([1.0, 1.0, -1.0]))
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-12)


def test_it_is_the_best_rigid_motion() -> None:
    source, target = poses(2)[:1], poses(2)[1:]
    fit = similarity(source, target, with_scale=False)
    best = np.sum((apply_similarity(source, *fit) - target) ** 2)
    for r in Rotation.random(300, random_state=2).as_matrix():
        moved = source @ r.T
        moved = moved - moved.mean(1) + target.mean(1)
        assert best <= np.sum((moved - target) ** 2) + 1e-9


def test_the_torso_frame_turns_with_the_body() -> None:
    s = poses(30)
    r = Rotation.random(30, random_state=0).as_matrix()
    frame = torso_frame(s)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-12)
    np.testing.assert_allclose(torso_frame(s @ np.swapaxes(r, 1, 2)), r @ frame, atol=1e-12)
    shape, rotation = to_torso_frame(s)
    np.testing.assert_allclose(shape @ np.swapaxes(rotation, 1, 2), s, atol=1e-12)


def test_the_axes_point_forward_left_and_up() -> None:
    s = np.zeros((15, 3))
    s[BODY_15.index("neck")] = [0.0, 0.0, 0.5]
    s[BODY_15.index("lhip")], s[BODY_15.index("rhip")] = [0.0, 0.1, 0.0], [0.0, -0.1, 0.0]
    s[BODY_15.index("lshoulder")], s[BODY_15.index("rshoulder")] = [0.0, 0.2, 0.4], [0.0, -0.2, 0.4]
    np.testing.assert_allclose(torso_frame(s), np.eye(3), atol=1e-12)


def test_a_body_without_extent_still_has_a_frame() -> None:
    frame = torso_frame(np.zeros((2, 15, 3)))
    np.testing.assert_allclose(frame @ np.swapaxes(frame, 1, 2), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)


POSES = make_walk(5).shape


def test_bone_of_a_joint_stands_one_place_before_it() -> None:
    for joint, parent in enumerate(BODY_15.parents[1:], start=1):
        expected = np.linalg.norm(POSES[:, joint] - POSES[:, parent], axis=-1)
        np.testing.assert_allclose(bone_lengths(POSES)[:, joint - 1], expected)


def test_limb_lengths_are_those_of_the_rigid_bones() -> None:
    lengths = limb_lengths(POSES)
    assert lengths.shape == (5, len(RIGID_BONES))
    for column, (start, end) in zip(lengths.T, RIGID_BONES, strict=True):
        expected = np.linalg.norm(POSES[:, BODY_15.index(end)] - POSES[:, BODY_15.index(start)], axis=-1)
        np.testing.assert_array_equal(column, expected)
