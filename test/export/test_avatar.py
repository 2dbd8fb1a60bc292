"""The newest pose on an avatar's bones, as a VMC receiver applies them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.export.avatar import BONE_PARENTS, BONES, LiveRig, up_of_pitch, y_up_of
from drocap_ros.export.live_messages import json_text, vmc_packet
from drocap_ros.export.rig import rig_of
from drocap_ros.export.take import Take, y_up
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15, BODY_17

NAMES = list(BONES.values())
STEP_NS = 33_333_333


def t_pose():
    """(15, 3) y up, facing +z, left at +x."""
    take = y_up(
        Take(simulate_person(np.zeros(2), "stand", 1), BODY_15.joints, BODY_15.parents, np.arange(2) / 30, 30.0)
    )
    rig, _ = rig_of(take)
    out = np.full((15, 3), np.nan)
    for name, place in zip(rig.joints, rig.rest, strict=True):
        if name in BODY_15.joints:
            out[BODY_15.index(name)] = place
    return out


def posed(joints, confidence=None, joints_of=BODY_15):
    rig = LiveRig(joints_of.joints)
    return rig.pose(joints, np.ones(len(joints)) if confidence is None else confidence, 0)


def received(pose):
    """Places and rotations (Unity's axes) of all bones by the receiver's rules, from the bytes of a packet."""
    osc_bundle = pytest.importorskip("pythonosc.osc_bundle")
    place, turn = {}, {}
    root = None
    for message in osc_bundle.OscBundle(vmc_packet(pose, 1.0)):
        if message.address.endswith("Pos"):
            name, *values = message.params
            offset, rotation = np.array(values[:3]), Rotation.from_quat(values[3:])
            if name == "root":
                root = offset
                continue
            parent = BONE_PARENTS[NAMES.index(name)]
            above = NAMES[parent] if parent >= 0 else None
            place[name] = place[above] + turn[above].apply(offset) if above else root + offset
            turn[name] = turn[above] * rotation if above else rotation
    return place, turn


def bent(joints, elbow, wrist, turn):
    out = joints.copy()
    at = BODY_15.index(elbow)
    out[BODY_15.index(wrist)] = out[at] + turn.apply(out[BODY_15.index(wrist)] - out[at])
    return out


def test_t_pose_turns_no_bone():
    rotations = Rotation.from_quat(posed(t_pose()).unity().rotations)
    assert np.degrees(rotations.magnitude()).max() < 0.5


def test_root_and_height_of_the_hips_are_two_messages_and_the_place_of_the_person():
    joints = t_pose() + np.array([2.0, 0.3, -5.0])
    place, _ = received(posed(joints))
    np.testing.assert_allclose(place["Hips"], joints[0] * [-1, 1, 1], atol=1e-5)


@pytest.mark.parametrize(
    ("axis", "unity"),
    [
        # The left forearm points at +x of ours, at -x in Unity.  Ours about +y by 90 degrees: -z, backwards.
        ("y", [0, -np.sqrt(0.5), 0, np.sqrt(0.5)]),
        ("z", [0, 0, -np.sqrt(0.5), np.sqrt(0.5)]),  # upwards
    ],
)
def test_turn_of_the_left_elbow_has_unitys_handedness(axis, unity):
    pose = posed(bent(t_pose(), "lelbow", "lwrist", Rotation.from_euler(axis, 90, degrees=True))).unity()
    got = pose.rotations[NAMES.index("LeftLowerArm")]
    np.testing.assert_allclose(got * np.sign(got[3]), unity, atol=0.01)
    # What a left-handed engine makes of it: the same formula for a vector, in its axes.
    forearm = Rotation.from_quat(got).apply([-1.0, 0.0, 0.0])
    np.testing.assert_allclose(forearm, {"y": [0, 0, -1], "z": [0, 1, 0]}[axis], atol=0.01)


def test_mirrored_person_has_mirrored_bones():
    joints = simulate_person(np.array([0.7]), "boxing", 3)[0]
    joints = y_up_of(joints)
    joints -= joints[0]
    mirrored = joints[BODY_15.mirror] * [-1, 1, 1]
    one, other = posed(joints).rotations, posed(mirrored).rotations
    for bone, name in enumerate(NAMES):
        twin = NAMES.index(name.replace("Left", "*").replace("Right", "Left").replace("*", "Right"))
        turned = one[bone] * [1, -1, -1, 1]
        assert (Rotation.from_quat(turned).inv() * Rotation.from_quat(other[twin])).magnitude() < 1e-6, name


@pytest.mark.parametrize("action", ["walk", "boxing", "kicking", "squats", "mixed"])
def test_receivers_kinematics_reproduces_the_joints_within_the_error_of_the_bones(action):
    joints = simulate_person(np.arange(150) / 30, action, 4)
    rig, offs, out = LiveRig(BODY_15.joints), [], {}
    for frame, z_up in enumerate(joints):
        positions = y_up_of(z_up)
        out, _ = received(rig.pose(positions, np.ones(15), frame * STEP_NS))
        expected = {BONES[name]: positions[BODY_15.index(name)] for name in BODY_15.joints if name in BONES}
        expected["Head"] = positions[BODY_15.index("neck")]
        offs.append([np.linalg.norm(out[name] - place * [-1, 1, 1]) for name, place in expected.items()])
    assert np.mean(offs) < 0.02
    assert np.max(offs) < 0.12  # the shoulders of a person are no rigid body


def test_bones_are_those_of_the_exports_rig():
    joints = simulate_person(np.arange(60) / 30, "walk", 2)
    take = y_up(Take(joints, BODY_15.joints, BODY_15.parents, np.arange(60) / 30, 30.0))
    rig, _ = rig_of(take, names="lafan1")
    live = LiveRig(BODY_15.joints)
    poses = [live.pose(p, np.ones(15), i * STEP_NS) for i, p in enumerate(take.positions)]
    for joint in ("lknee", "rhip", "lelbow", "rshoulder"):
        there = rig.local(rig.joints.index(joint))[-1]
        here = Rotation.from_quat(poses[-1].rotations[list(BONES).index(joint)])
        assert np.degrees((there.inv() * here).magnitude()) < 12.0, joint  # the export fits, this points as measured


def test_no_bone_jumps_while_a_forearm_passes_the_direction_against_its_rest():
    rig, last = LiveRig(BODY_15.joints), None
    for frame, angle in enumerate(np.radians(np.arange(120, 240, 2.0))):
        around = 0.05 * np.sin(7.0 * angle)
        joints = bent(t_pose(), "lelbow", "lwrist", Rotation.from_rotvec([around, angle, 0]))
        turn = Rotation.from_quat(rig.pose(joints, np.ones(15), frame * STEP_NS).rotations[NAMES.index("LeftLowerArm")])
        assert last is None or np.degrees((last.inv() * turn).magnitude()) < 20.0
        last = turn


def test_what_is_not_seen_is_at_rest_and_without_a_trunk_there_is_no_pose():
    joints, seen = t_pose(), np.ones(15)
    joints[BODY_15.index("lwrist")] += [-0.2, 0.3, 0.1]
    joints[BODY_15.index("rknee")] += [0.0, 0.2, 0.3]
    seen[[BODY_15.index(n) for n in ("rknee", "rankle")]] = 0.0  # a method's guess
    hidden = joints.copy()
    hidden[BODY_15.index("lwrist")] = np.nan
    rotations = dict(zip(NAMES, posed(hidden, seen).rotations, strict=True))
    for name in ("LeftLowerArm", "RightUpperLeg", "RightLowerLeg"):
        assert Rotation.from_quat(rotations[name]).magnitude() < 1e-9
    assert all(np.isfinite(posed(hidden, seen).positions()).ravel())
    rig = LiveRig(BODY_15.joints)
    rig.pose(joints, np.ones(15), 0)
    again = rig.pose(joints, seen, STEP_NS)  # seen before: it stays followed
    assert Rotation.from_quat(again.rotations[NAMES.index("RightUpperLeg")]).magnitude() > 0.1
    joints[BODY_15.index("lhip")] = np.nan
    assert rig.pose(joints, np.ones(15), 2 * STEP_NS) is None


def test_pose_of_a_camera_is_leveled_by_its_pitch_and_stands_on_the_floor():
    joints = t_pose()
    optical = joints * [1, -1, -1]
    tilt = np.radians(-30.0)
    tilted = Rotation.from_euler("x", -tilt).apply(optical * [1, -1, -1]) * [1, -1, -1]
    np.testing.assert_allclose(y_up_of(optical, up_of_pitch(0.0)), joints, atol=1e-12)
    np.testing.assert_allclose(y_up_of(tilted, up_of_pitch(tilt)), joints, atol=1e-9)
    pose = LiveRig(BODY_15.joints).pose(joints - joints[0], np.ones(15), 0, on_floor=True)
    assert 0.0 < pose.positions()[NAMES.index("LeftFoot"), 1] < 0.1
    assert pose.place[1] > 0.7


def test_toes_of_the_larger_set_change_no_bone_above_the_foot():
    joints = y_up_of(simulate_person(np.array([0.4]), "walk", 5)[0])
    feet = joints[[BODY_15.index("rankle"), BODY_15.index("lankle")]] + [0.0, -0.05, 0.15]
    with_toes, without = posed(np.concatenate([joints, feet]), joints_of=BODY_17), posed(joints)
    feet_bones = [NAMES.index("LeftFoot"), NAMES.index("RightFoot")]
    off = np.abs(with_toes.rotations - without.rotations).max(axis=1)
    assert set(np.flatnonzero(off > 1e-9)) <= set(feet_bones)


def test_nobody_is_a_bundle_without_bones():
    osc_bundle = pytest.importorskip("pythonosc.osc_bundle")
    messages = list(osc_bundle.OscBundle(vmc_packet(None, 2.5)))
    assert [m.address for m in messages] == ["/VMC/Ext/OK", "/VMC/Ext/T"]
    assert messages[0].params == [1, 3, 0, 0]
    assert '"seen": false' in json_text(None, 5, "odom")
