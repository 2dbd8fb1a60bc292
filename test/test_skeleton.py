"""Joint sets: trees, sides, mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from drocap_ros.skeleton import BODY_15, COCO_17, JOINT_SETS, joint_set


@pytest.mark.parametrize("name", sorted(JOINT_SETS))
def test_joint_sets_are_trees_with_sides(name):
    s = joint_set(name)
    assert len(s.joints) == len(s.parents) == len(set(s.joints))
    for start in range(len(s)):
        joint, steps = start, 0
        while s.parents[joint] >= 0:
            joint, steps = s.parents[joint], steps + 1
            assert steps <= len(s), f"{s.joints[start]} hangs in a circle"
    assert (s.mirror[s.mirror] == np.arange(len(s))).all()
    assert (s.mirror != np.arange(len(s))).sum() >= 12


def test_mirror_is_an_involution_that_exchanges_the_sides():
    for joints in JOINT_SETS.values():
        np.testing.assert_array_equal(joints.mirror[joints.mirror], np.arange(len(joints)))
    assert BODY_15.joints[BODY_15.mirror[BODY_15.index("rwrist")]] == "lwrist"
    assert COCO_17.joints[COCO_17.mirror[COCO_17.index("left_ear")]] == "right_ear"
    assert BODY_15.mirror[BODY_15.index("neck")] == BODY_15.index("neck")
