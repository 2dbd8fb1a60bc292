"""Constant bones by inverse kinematics, and the rotations that reproduce the joints."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drocap_ros.errors import InputError
from drocap_ros.export.animation import write_bvh
from drocap_ros.export.rig import rig_of
from drocap_ros.export.rigid_body import fit_rigid_body
from drocap_ros.export.take import take_of, y_up
from drocap_ros.skeleton import BODY_15, H36M_17


def clip_with(walker, joints, names=BODY_15.joints, parents=BODY_15.parents, rate_hz=24.0):
    return dataclasses.replace(
        y_up(take_of(walker)),
        positions=joints,
        joints=names,
        parents=parents,
        rate_hz=rate_hz,
        times_s=np.arange(len(joints)) / rate_hz,
    )


def off(rig, joints, names=BODY_15.joints):
    """Distances (F, P) from the joints, up to the constant height of the floor."""
    posed = rig.positions()[:, [rig.joints.index(name) for name in names]] - joints
    posed[..., 1] -= np.median(posed[..., 1])
    return np.linalg.norm(posed, axis=2)


def test_forward_kinematics_reproduces_joints_with_constant_bones(walker):
    joints = y_up(take_of(walker)).positions
    rig, _ = rig_of(clip_with(walker, joints))
    assert off(rig, joints).max() < 1e-3
    assert off(rig, joints).mean() < 1e-4


def test_changing_bones_become_constant_with_small_moves(walker):
    """Errors of 10 mm of each coordinate change the bones; the fit moves a joint by less than that error."""
    noise = np.random.default_rng(1).normal(0, 0.010, walker.joints3d.shape)
    truth = y_up(take_of(walker)).positions
    rig, notes = rig_of(clip_with(walker, truth + noise))
    posed = rig.positions()
    bones = np.linalg.norm(posed[:, 1:] - posed[:, rig.parents[1:]], axis=2)
    assert np.ptp(bones, axis=0).max() < 1e-9
    assert 0.002 < off(rig, truth + noise).mean() < 0.010
    # Constant bones remove a part of the error.
    assert off(rig, truth).mean() < 0.95 * np.linalg.norm(noise, axis=2).mean()
    assert any("bones made constant" in note for note in notes)


def test_fit_is_at_a_minimum(walker):
    """No small turn of a limb, the pelvis or the root brings the joints nearer."""
    noise = np.random.default_rng(2).normal(0, 0.02, walker.joints3d.shape)
    joints = y_up(take_of(walker)).positions + noise
    body = fit_rigid_body(joints, BODY_15.joints, np.ones(joints.shape[:2], bool), far_m=np.inf)
    posed = np.stack([body.at(name) for name in BODY_15.joints], axis=1)
    residual = posed - joints
    # The gradient along the root's translation (0.07 mm of the mean) and the turn of a forearm and a shank.
    assert np.abs(residual.mean(axis=1)).max() < 7e-5
    for name, parent in (("lwrist", "lelbow"), ("rankle", "rknee")):
        torque = np.cross(body.at(name) - body.at(parent), residual[:, BODY_15.index(name)])
        assert np.abs(torque).max() < 1e-4


def test_no_joint_bears_the_whole_misfit_of_a_frame(walker):
    """A trunk that is 75 mm too short in a third of the frames: least squares would leave the shoulders far off."""
    joints = y_up(take_of(walker)).positions.copy()
    below = [BODY_15.index(name) for name in ("pelvis", "lhip", "rhip", "lknee", "rknee", "lankle", "rankle")]
    joints[::3, below] += (0.0, 0.075, 0.0)
    known = np.ones(joints.shape[:2], bool)
    off = []
    for far_m in (np.inf, 0.02):
        body = fit_rigid_body(joints, BODY_15.joints, known, far_m=far_m)
        posed = np.stack([body.at(name) for name in BODY_15.joints], axis=1)
        off.append(np.linalg.norm(posed - joints, axis=2))
    assert off[0].max() > 0.025
    assert off[1].max() < 0.022
    assert off[1].mean() < 1.2 * off[0].mean()


@pytest.mark.parametrize("rest", ["t", "a"])
def test_rest_pose_has_identity_rotations(walker, rest):
    """A body that stands in the rest pose facing +z has the identity everywhere."""
    down = np.radians({"t": 0.0, "a": 45.0}[rest])
    arm = 0.3 * np.array([np.cos(down), -np.sin(down), 0.0])
    joints = np.zeros((3, 15, 3))
    offsets = {
        "rhip": (-0.1, 0, 0), "rknee": (0, -0.4, 0), "rankle": (0, -0.4, 0), "lhip": (0.1, 0, 0),
        "lknee": (0, -0.4, 0), "lankle": (0, -0.4, 0), "neck": (0, 0.6, 0), "head": (0, 0.1, 0),
        "lshoulder": (0.16, -0.12, 0), "lelbow": arm, "lwrist": arm,
        "rshoulder": (-0.16, -0.12, 0), "relbow": arm * (-1, 1, 1), "rwrist": arm * (-1, 1, 1),
    }  # fmt: skip
    for joint, parent in enumerate(BODY_15.parents):
        if parent >= 0:
            joints[:, joint] = joints[:, parent] + offsets[BODY_15.joints[joint]]
    rig, _ = rig_of(clip_with(walker, joints, rate_hz=30.0), rest=rest)
    for rotation in rig.turned:
        np.testing.assert_allclose(rotation.magnitude(), 0.0, atol=1e-6)
    common = [rig.joints.index(name) for name in BODY_15.joints]
    np.testing.assert_allclose(rig.positions()[0, common], rig.rest[common] - rig.rest[0] + rig.root[0], atol=1e-7)


def test_rotations_are_continuous_where_a_bone_passes_its_opposite_direction(walker):
    """A forearm that swings past the direction opposite to its rest: the smallest rotation alone would jump by pi."""
    joints = np.repeat(y_up(take_of(walker)).positions[:1], 240, axis=0)
    elbow, wrist = BODY_15.index("lelbow"), BODY_15.index("lwrist")
    rig, _ = rig_of(clip_with(walker, joints, rate_hz=60.0))
    rest = rig.turned[rig.joints.index("lshoulder")][0].apply([1.0, 0.0, 0.0])
    across = np.cross(rest, [0.3, 0.5, 0.8])
    across /= np.linalg.norm(across)
    aside = np.cross(rest, across)
    angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 240)[:, None]
    direction = np.cos(angle) * rest + np.sin(angle) * across + 0.01 * aside
    joints[:, wrist] = joints[:, elbow] + 0.25 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    rig, _ = rig_of(clip_with(walker, joints, rate_hz=60.0))
    turned = rig.turned[rig.joints.index("lelbow")]
    step = (turned[:-1].inv() * turned[1:]).magnitude()
    # The bone itself turns by 0.75 degrees a frame, and at most one turn of twist fades by 1 in 30 a frame.
    assert np.degrees(step).max() < 0.76 + 360.0 / 30.0
    rig, _ = rig_of(clip_with(walker, np.repeat(joints[-1:], 600, axis=0), rate_hz=60.0))
    still = rig.turned[rig.joints.index("lelbow")]
    np.testing.assert_allclose((still[:-1].inv() * still[1:]).magnitude(), 0.0, atol=1e-9)


@pytest.mark.parametrize(("first_deg", "last_deg"), [(0, 130), (130, -30)])
def test_bvh_channels_do_not_flip_in_a_squat(walker, tmp_path, first_deg, last_deg):
    """A knee that bends past 90 degrees: in the order Z X Y every rotation has two solutions, half turns apart."""
    joints = np.repeat(take_of(walker).positions[:1], 15, axis=0)
    hip, knee, ankle = (BODY_15.index(name) for name in ("lhip", "lknee", "lankle"))
    aside = joints[0, hip] - joints[0, BODY_15.index("rhip")]
    turn = np.radians(np.linspace(first_deg, last_deg, 15))[:, None] * aside / np.linalg.norm(aside)
    joints[:, ankle] = joints[:, knee] + Rotation.from_rotvec(turn).apply(joints[:, knee] - joints[:, hip])
    write_bvh(
        tmp_path / "squat.bvh", dataclasses.replace(take_of(walker), positions=joints, times_s=np.arange(15) / 24)
    )
    rows = (tmp_path / "squat.bvh").read_text().split("Frame Time:")[1].splitlines()[1:]
    channels = np.array([row.split() for row in rows], float)[:, 3:]
    assert np.abs(np.diff(channels, axis=0)).max() < 45.0
    assert channels.max() == pytest.approx(130.0, abs=0.5)


def test_limbs_have_no_twist_of_their_own(walker):
    """The rotation of a forearm or thigh relative to its parent is about an axis across the bone."""
    rig, _ = rig_of(clip_with(walker, y_up(take_of(walker)).positions))
    for joint, along in (("lelbow", (1, 0, 0)), ("relbow", (1, 0, 0)), ("lhip", (0, 1, 0)), ("rhip", (0, 1, 0))):
        turn = rig.local(rig.joints.index(joint)).as_rotvec()
        assert np.degrees(np.abs(turn @ along)).max() < 0.5
        assert np.degrees(np.linalg.norm(turn, axis=1)).max() > 5


def test_measured_toes_make_the_feet_and_other_joints_are_left_out(walker):
    """Human3.6M's tree with spine and thorax, and toes."""
    body = y_up(take_of(walker)).positions
    at = {name: body[:, BODY_15.index(name)] for name in BODY_15.joints}
    at["spine"] = 0.5 * at["pelvis"] + 0.5 * at["neck"]
    at["thorax"] = 0.2 * at["pelvis"] + 0.8 * at["neck"]
    names = (*H36M_17.joints, "rtoe", "ltoe")
    parents = (*H36M_17.parents, H36M_17.index("rankle"), H36M_17.index("lankle"))
    forwards = np.cross(at["lhip"] - at["rhip"], [0.0, 1.0, 0.0])
    forwards *= 0.15 / np.linalg.norm(forwards, axis=1, keepdims=True)
    for side in "rl":
        at[side + "toe"] = at[side + "ankle"] + forwards - (0.0, 0.05, 0.0)
    joints = np.stack([at[name] for name in names], axis=1)
    rig, notes = rig_of(clip_with(walker, joints, names, parents))
    used = (*BODY_15.joints, "rtoe", "ltoe")
    assert off(rig, np.stack([at[name] for name in used], axis=1), used).max() < 1e-3
    assert any("left out, not in the rigid body: spine, thorax" in note for note in notes)
    assert not any("assumed" in note for note in notes)
    toe = rig.rest[rig.joints.index("ltoe")] - rig.rest[rig.joints.index("lankle")]
    assert np.linalg.norm(toe) == pytest.approx(np.hypot(0.15, 0.05), abs=1e-6)
    assert toe[2] > 0.8 * np.linalg.norm(toe)


def test_feet_stand_on_the_floor(walker, in_camera):
    """Known root motion: one height for all frames.  Unknown: the lower foot stands in every frame."""
    for motion in (walker, in_camera):
        rig, notes = rig_of(y_up(take_of(motion)))
        ankles = rig.positions()[:, [rig.joints.index(name) for name in ("lankle", "rankle")], 1]
        height = rig.rest[rig.joints.index("lankle"), 1]
        assert 0.05 < height < 0.1
        lower = ankles.min(axis=1) - height
        assert abs(np.percentile(lower, 5)) < 1e-3
        if motion is in_camera:
            np.testing.assert_allclose(lower, 0.0, atol=0.003)
            assert any("no root motion" in note for note in notes)
        else:
            moved = rig.root - y_up(take_of(motion)).positions[:, 0]
            assert np.ptp(moved, axis=0).max() < 2e-3
            assert any("floor at 0" in note for note in notes)


def test_no_joint_is_below_the_floor_in_a_handstand(in_camera):
    upside_down = dataclasses.replace(in_camera, joints3d=in_camera.joints3d * (-1.0, -1.0, 1.0))
    rig, _ = rig_of(y_up(take_of(upside_down)))
    np.testing.assert_allclose(rig.positions()[..., 1].min(axis=1), 0.0, atol=1e-6)


def test_missing_joints_and_unknown_options_are_refused(walker):
    clip = y_up(take_of(walker))
    with pytest.raises(InputError, match="missing rwrist"):
        rig_of(clip_with(walker, clip.positions[:, :14], BODY_15.joints[:14], BODY_15.parents[:14]))
    with pytest.raises(InputError, match="names: expected one of h36m, lafan1, mixamo, mixamo-three, got 'vicon'"):
        rig_of(clip, names="vicon")
    with pytest.raises(InputError, match="rest: expected one of t, a"):
        rig_of(clip, rest="sitting")
