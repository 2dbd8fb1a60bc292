"""Flexion of knees, hips and elbows."""

from __future__ import annotations

import numpy as np

from drocap_ros.report.movement import flexion, flexion_words
from drocap_ros.skeleton import BODY_15


def standing(frames: int = 3) -> np.ndarray:
    """(F, 15, 3) m, straight limbs, arms hanging."""
    place = {
        "pelvis": (0, 0, 0.9), "neck": (0, 0, 1.5), "head": (0, 0, 1.6),
        "rhip": (0, -0.1, 0.9), "rknee": (0, -0.1, 0.5), "rankle": (0, -0.1, 0.1),
        "lhip": (0, 0.1, 0.9), "lknee": (0, 0.1, 0.5), "lankle": (0, 0.1, 0.1),
        "rshoulder": (0, -0.2, 1.4), "relbow": (0, -0.2, 1.1), "rwrist": (0, -0.2, 0.8),
        "lshoulder": (0, 0.2, 1.4), "lelbow": (0, 0.2, 1.1), "lwrist": (0, 0.2, 0.8),
    }  # fmt: skip
    return np.tile(np.array([place[name] for name in BODY_15.joints]), (frames, 1, 1))


def test_straight_limbs_have_no_flexion_and_bent_ones_their_angle():
    joints = standing()
    assert all(np.allclose(angle, 0.0, atol=1e-6) for angle in flexion(joints, BODY_15.joints).values())
    joints[:, BODY_15.index("rankle")] = (-0.4, -0.1, 0.5)
    joints[:, BODY_15.index("lwrist")] = (0.3 * np.sin(0.5), 0.2, 1.1 - 0.3 * np.cos(0.5))
    bent = flexion(joints, BODY_15.joints)
    np.testing.assert_allclose(bent["knee"], np.tile([90.0, 0.0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(bent["elbow"], np.tile([0.0, np.degrees(0.5)], (3, 1)), atol=1e-6)
    assert flexion_words(joints, BODY_15.joints) == "knees 90 and 0, hips 0 and 0, elbows 0 and 29 degrees"


def test_unknown_joints_and_skeletons_have_no_words():
    joints = standing()
    joints[1] = np.nan
    assert flexion_words(joints, BODY_15.joints).startswith("knees 0 and 0")
    assert flexion_words(np.full((3, 15, 3), np.nan), BODY_15.joints) == ""
    assert flexion_words(joints[:, :3], BODY_15.joints[:3]) == ""
