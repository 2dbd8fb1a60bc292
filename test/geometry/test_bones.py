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


def test_limb_lengths_are_those_of_the_rigid_bones() -> None:
    lengths = limb_lengths(POSES)
    assert lengths.shape == (5, len(RIGID_BONES))
    for column, (start, end) in zip(lengths.T, RIGID_BONES, strict=True):
        expected = np.linalg.norm(POSES[:, BODY_15.index(end)] - POSES[:, BODY_15.index(start)], axis=-1)
        np.testing.assert_array_equal(column, expected)
