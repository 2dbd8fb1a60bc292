"""Constant bones and the rotations that reproduce the joints."""

import numpy as np
import pytest

from drocap_ros.export.rig import fit_rig
from drocap_ros.skeleton import BODY_15, H36M_17


def y_up(walker):
    x, y, z = np.moveaxis(walker.joints3d, -1, 0)
    return np.stack([x, z, -y], axis=-1)


def test_forward_kinematics_reproduces_the_joints(walker):
    joints = y_up(walker)
    rig = fit_rig(joints, BODY_15.joints, BODY_15.parents, 24.0)
    np.testing.assert_allclose(rig.positions(joints[:, 0], BODY_15.parents), joints, atol=1e-6)


def test_rest_pose_has_identity_rotations():
    """A body that stands in a T facing +z has the identity everywhere."""
    joints = np.zeros((3, 15, 3))
    offsets = {
        "rhip": (-0.1, 0, 0), "rknee": (0, -0.4, 0), "rankle": (0, -0.4, 0), "lhip": (0.1, 0, 0),
        "lknee": (0, -0.4, 0), "lankle": (0, -0.4, 0), "neck": (0, 0.6, 0), "head": (0, 0.1, 0),
        "lshoulder": (0.16, -0.12, 0), "lelbow": (0.3, 0, 0), "lwrist": (0.3, 0, 0),
        "rshoulder": (-0.16, -0.12, 0), "relbow": (-0.3, 0, 0), "rwrist": (-0.3, 0, 0),
    }  # fmt: skip
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            joints[:, joint] = joints[:, parent] + offsets[BODY_15.joints[joint]]
    rig = fit_rig(joints, BODY_15.joints, BODY_15.parents, 30.0)
    for rotation in (*rig.turned, *rig.aimed):
        np.testing.assert_allclose(rotation.magnitude(), 0.0, atol=1e-7)


def test_rotations_are_continuous_where_a_bone_passes_its_opposite_direction(walker):
    """A forearm that swings past the direction opposite to its rest: the smallest rotation alone would jump by pi."""
    joints = np.repeat(y_up(walker)[:1], 240, axis=0)
    elbow, wrist = BODY_15.index("lelbow"), BODY_15.index("lwrist")
    rig = fit_rig(joints, BODY_15.joints, BODY_15.parents, 60.0)
    rest = rig.turned[BODY_15.index("lshoulder")][0].apply([1.0, 0.0, 0.0])
    across = np.cross(rest, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    aside = np.cross(rest, across)
    angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 240)[:, None]
    direction = np.cos(angle) * rest + np.sin(angle) * across + 0.01 * aside
    joints[:, wrist] = joints[:, elbow] + 0.25 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    turned = fit_rig(joints, BODY_15.joints, BODY_15.parents, 60.0).turned[elbow]
    step = (turned[:-1].inv() * turned[1:]).magnitude()
    # The bone itself turns by 0.75 degrees a frame, and at most one turn of twist fades by 1 in 30 a frame.
    assert np.degrees(step).max() < 0.76 + 360.0 / 30.0
    still = fit_rig(np.repeat(joints[-1:], 600, axis=0), BODY_15.joints, BODY_15.parents, 60.0).turned[elbow]
    np.testing.assert_allclose((still[:-1].inv() * still[1:]).magnitude(), 0.0, atol=1e-9)


def test_other_trees_and_joints_without_an_entry_are_posed(walker):
    """Human3.6M's tree with spine and thorax, and a joint of which the table knows nothing."""
    body = y_up(walker)
    at = {name: body[:, BODY_15.index(name)] for name in BODY_15.joints}
    at["spine"] = 0.5 * at["pelvis"] + 0.5 * at["neck"]
    at["thorax"] = 0.2 * at["pelvis"] + 0.8 * at["neck"]
    names, parents = (*H36M_17.joints, "rtoe"), (*H36M_17.parents, H36M_17.index("rankle"))
    at["rtoe"] = at["rankle"] + 0.15 * np.cross(at["lhip"] - at["rhip"], [0.0, 1.0, 0.0])
    joints = np.stack([at[name] for name in names], axis=1)
    rig = fit_rig(joints, names, parents, 24.0)
    posed = rig.positions(joints[:, 0], parents)
    lengths = np.linalg.norm(joints - joints[:, np.maximum(parents, 0)], axis=2)
    spread = np.ptp(lengths, axis=0).max()
    assert np.linalg.norm(posed - joints, axis=2).max() <= 4 * spread + 1e-6
    toe = rig.offsets[-1]
    assert toe[2] == pytest.approx(np.linalg.norm(toe), rel=0.35)  # feet point forward, along z
