"""Joint angles against simulated motions with known ones."""

import csv
import dataclasses

import numpy as np
import pytest
from walking import make_walk

from drocap_ros.cli import main
from drocap_ros.export.measured import joint_angles
from drocap_ros.export.rigid_body import fit_rigid_body
from drocap_ros.geometry.rotations import exp_so3
from drocap_ros.motion import save_motion
from drocap_ros.report.movement import bend_deviations
from drocap_ros.skeleton import BODY_15

FRAMES = 120


def angles_of(z_up_joints, names=BODY_15.joints):
    joints = z_up_joints[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    return joint_angles(fit_rigid_body(joints, names, np.ones(joints.shape[:2], bool)), 24.0)


def rms(a, b):
    return float(np.sqrt(np.mean((a - b) ** 2)))


def turned(joints, radians):
    """About the vertical, by an angle per frame."""
    return np.einsum("fij,fpj->fpi", exp_so3(np.multiply.outer(radians, [0.0, 0.0, 1.0])), joints)


@pytest.fixture(scope="module")
def walk():
    return make_walk(FRAMES).shape


def test_angles_of_a_simulated_walk_are_known(walk):
    """Thigh and shank swing by stated angles; the trunk, by 2.7 degrees not upright, is the reference of the hips."""
    found = angles_of(walk)
    phase = 2.0 * np.pi * 0.9 * np.arange(FRAMES) / 24.0
    for side, sign in (("left", 1.0), ("right", -1.0)):
        assert rms(found[f"{side}_hip_flexion"], np.degrees(0.5 * sign * np.sin(phase))) < 5.0
        assert rms(found[f"{side}_knee_flexion"], np.degrees(0.5 + 0.3 * sign * np.cos(phase))) < 0.5
        assert rms(found[f"{side}_elbow_flexion"], np.degrees(0.7)) < 0.5
        assert np.ptp(found[f"{side}_hip_flexion"]) == pytest.approx(np.degrees(1.0), abs=1.0)


def test_signs_and_zeros_are_those_of_the_docs(walk):
    pose = np.zeros((3, 15, 3))
    at = {
        "lhip": (0, 0.1, 0), "lknee": (0.1, 0.2, -0.4), "lankle": (-0.1, 0.2, -0.8), "rhip": (0, -0.1, 0),
        "rknee": (0.4, -0.1, 0.0), "rankle": (0.4, -0.1, -0.4), "neck": (0, 0, 0.6), "head": (0.1, 0, 0.7),
        "lshoulder": (0, 0.2, 0.5), "lelbow": (0, 0.5, 0.5), "lwrist": (0.25, 0.5, 0.5),
        "rshoulder": (0, -0.2, 0.5), "relbow": (0.3, -0.2, 0.5), "rwrist": (0.3, -0.2, 0.75),
    }  # fmt: skip
    for name, place in at.items():
        pose[:, BODY_15.index(name)] = place
    found = {name: values[1] for name, values in angles_of(pose).items()}
    for name in ("pelvis_tilt", "pelvis_obliquity", "trunk_flexion", "trunk_bending", "trunk_rotation", "head_bending"):
        assert found[name] == pytest.approx(0.0, abs=0.5)
    assert found["head_flexion"] == pytest.approx(45.0, abs=0.5)
    # A thigh level to the front, the shank down; the other leg to the side, bent a little.
    assert found["right_hip_flexion"] == pytest.approx(90.0, abs=0.5)
    assert found["right_knee_flexion"] == pytest.approx(90.0, abs=0.5)
    assert found["left_hip_flexion"] == pytest.approx(np.degrees(np.arctan2(0.1, 0.4)), abs=2.0)
    assert found["left_hip_adduction"] < -8
    assert found["left_knee_flexion"] == pytest.approx(42.4, abs=1.0)
    # Abduction is elevation in plane 0, flexion in plane 90; an upper arm with the forearm to the front or up.
    assert found["left_shoulder_elevation"] == pytest.approx(90.0, abs=0.5)
    assert found["left_shoulder_plane"] == pytest.approx(0.0, abs=0.5)
    assert found["right_shoulder_elevation"] == pytest.approx(90.0, abs=0.5)
    assert found["right_shoulder_plane"] == pytest.approx(90.0, abs=0.5)
    assert found["left_elbow_flexion"] == pytest.approx(90.0, abs=0.5)
    assert found["right_elbow_flexion"] == pytest.approx(90.0, abs=0.5)


def test_both_sides_have_the_same_signs(walk):
    """The mirrored person has the angles of the other side."""
    mirrored = walk[:, BODY_15.mirror] * (1.0, -1.0, 1.0)
    found, other = angles_of(walk), angles_of(mirrored)
    for name, values in found.items():
        if name.startswith("left_"):
            difference = values - other[name.replace("left", "right")]
            np.testing.assert_allclose((difference + 180.0) % 360.0 - 180.0, 0.0, atol=1e-3)


def test_angles_are_continuous_while_the_person_turns_around_twice(walk):
    radians = np.linspace(0.0, 4.0 * np.pi, FRAMES)
    still, spun = angles_of(walk), angles_of(turned(walk, radians))
    np.testing.assert_allclose(spun["pelvis_rotation"] - still["pelvis_rotation"], np.degrees(radians), atol=0.1)
    for name in set(still) - {"pelvis_rotation"}:
        np.testing.assert_allclose(spun[name], still[name], atol=0.1)


def test_a_knee_that_bends_backwards_is_negative():
    walk = make_walk(FRAMES).shape.copy()
    for side in "lr":
        hip, knee, ankle = (walk[:, BODY_15.index(side + name)] for name in ("hip", "knee", "ankle"))
        straight = knee - hip
        sideways = np.array([0.0, 1.0, 0.0])
        forwards = np.cross(sideways, straight)
        forwards *= 0.42 / np.linalg.norm(forwards, axis=1, keepdims=True)
        # The shank 8 degrees in front of the thigh's line.
        walk[:, BODY_15.index(side + "ankle")] = knee + straight * np.cos(0.14) - np.sin(0.14) * forwards
        assert np.all(np.abs(ankle - hip) < 1.0)
    found = angles_of(walk)
    for side in ("left", "right"):
        assert found[f"{side}_knee_flexion"].max() < -5.0
        assert found[f"{side}_knee_flexion"].min() > -11.0


def test_ankles_are_measured_where_the_motion_has_toes(walk):
    ankles = walk[:, [BODY_15.index("rankle"), BODY_15.index("lankle")]]
    shanks = ankles - walk[:, [BODY_15.index("rknee"), BODY_15.index("lknee")]]
    forwards = np.cross(shanks, [0.0, 1.0, 0.0])
    forwards /= np.linalg.norm(forwards, axis=2, keepdims=True)
    along = shanks / np.linalg.norm(shanks, axis=2, keepdims=True)
    toes = ankles + 0.15 * (np.cos(0.3) * forwards + np.sin(0.3) * along)
    found = angles_of(np.concatenate([walk, toes], axis=1), (*BODY_15.joints, "rtoe", "ltoe"))
    for side in ("left", "right"):
        # The toes 0.3 rad below the perpendicular of the shank.
        np.testing.assert_allclose(np.abs(found[f"{side}_ankle_dorsiflexion"]), np.degrees(0.3), atol=2.0)
        assert found[f"{side}_ankle_dorsiflexion"].max() < 0
    assert "left_ankle_dorsiflexion" not in angles_of(walk)


def test_command_writes_a_table_of_angles(walker, walk, tmp_path, capsys):
    save_motion(tmp_path / "motion.npz", dataclasses.replace(walker, joints3d=walk[:48]))
    assert main(["export", str(tmp_path), "--to", "csv-angles"]) == 0
    assert "joint angles, degrees" in capsys.readouterr().out
    with (tmp_path / "motion.angles.csv").open(newline="") as file:
        head, *rows = list(csv.reader(file))
    assert head[:3] == ["time_s", "frame", "pelvis_rotation_deg"]
    values = np.array(rows, float)
    expected = angles_of(walk[:48])
    deviations = [name for name in head if name.endswith("_sd_deg")]
    assert values.shape == (48, 2 + len(expected) + len(deviations) + 1)
    assert values[:, head.index("possible")].all()
    column = head.index("right_knee_flexion_deg")
    np.testing.assert_allclose(values[:, column], expected["right_knee_flexion"], atol=0.1)


def test_what_no_body_has_is_marked_and_deviations_are_those_of_the_report(walker, walk, tmp_path, capsys):
    joints = walk[:48].copy()
    names = {name: BODY_15.index(name) for name in BODY_15.joints}
    hip, knee = joints[:, names["rhip"]], joints[:, names["rknee"]]
    thigh = knee - hip
    joints[20:24, names["rankle"]] = knee[20:24] + (-0.97 * thigh + 0.2 * np.roll(thigh, 1, axis=1))[20:24]
    covariance = np.tile([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4], (48, 15, 1))
    motion = dataclasses.replace(walker, joints3d=joints, covariance=covariance, meta={"covariance_about": "pelvis"})
    save_motion(tmp_path / "motion.npz", motion)
    assert main(["export", str(tmp_path), "--to", "csv-angles"]) == 0
    assert "right knee flexion that no body has: " in capsys.readouterr().out
    with (tmp_path / "motion.angles.csv").open(newline="") as file:
        head, *rows = list(csv.reader(file))
    values = {name: np.array([float(row[at]) for row in rows]) for at, name in enumerate(head)}
    assert set(np.flatnonzero(values["possible"] == 0)) == {20, 21, 22, 23}
    expected = bend_deviations(motion)
    np.testing.assert_allclose(values["left_knee_flexion_sd_deg"], expected["knee"][:, 1], atol=1e-5)
