"""Bone lengths."""

from __future__ import annotations

import numpy as np
from walking import make_walk

from drocap_ros.geometry.bones import bone_lengths, limb_lengths
from drocap_ros.skeleton import BODY_15, RIGID_BONES

POSES = make_walk(5).shape


def test_bone_of_a_joint_stands_one_place_before_it() -> None:
    for joint, parent in enumerate(BODY_15.parents[1:], start=1):
        expected = np.linalg.norm(POSES[:, joint] - POSES[:, parent], axis=-1)
        np.testing.assert_allclose(bone_lengths(POSES)[:, joint - 1], expected)


def test_limb_lengths_follow_the_names_of_the_joints() -> None:
    order = np.random.default_rng(0).permutation(15)
    shuffled = limb_lengths(POSES[:, order], tuple(BODY_15.joints[i] for i in order))
    assert shuffled.shape == (5, len(RIGID_BONES))
    np.testing.assert_array_equal(shuffled, limb_lengths(POSES))
