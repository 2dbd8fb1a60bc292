"""OpenSim: the model's sizes without it; its inverse kinematics where it is installed."""

import dataclasses
import importlib.util
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from walking import make_walk

from drocap_ros.cli import main
from drocap_ros.export.opensim import model_xml
from drocap_ros.export.rigid_body import fit_rigid_body
from drocap_ros.motion import save_motion
from drocap_ros.skeleton import BODY_15


def body(toes=False):
    joints = make_walk(24).shape[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    names = BODY_15.joints
    if toes:
        ankles = joints[:, [BODY_15.index("rankle"), BODY_15.index("lankle")]]
        joints, names = (
            np.concatenate([joints, ankles + np.array([0.15, -0.05, 0.0])], axis=1),
            (*names, "rtoe", "ltoe"),
        )
    return fit_rigid_body(joints, names, np.ones(joints.shape[:2], bool))


def vector(element, tag):
    return np.array([float(word) for word in element.find(tag).text.split()])


@pytest.mark.parametrize("toes", [False, True])
def test_model_stands_in_the_sizes_of_the_motion(toes):
    fitted = body(toes)
    root = ElementTree.fromstring(model_xml(fitted).encode())
    places = {"ground": np.zeros(3)}
    for joint in root.iter("CustomJoint"):
        frame = joint.find("frames/PhysicalOffsetFrame")
        parent, child = frame.find("socket_parent").text, joint.find("socket_child_frame").text
        places[child.split("/")[-1]] = places[parent.split("/")[-1]] + vector(frame, "translation")
        axes = [vector(axis, "axis") for axis in joint.iter("TransformAxis")]
        assert abs(np.linalg.det(axes[:3])) == pytest.approx(1.0)
    at = {
        marker.get("name"): places[marker.find("socket_parent_frame").text.split("/")[-1]] + vector(marker, "location")
        for marker in root.iter("Marker")
    }
    assert set(at) == set(BODY_15.joints) | ({"rtoe", "ltoe"} if toes else set())
    # The person of make_walk in the default pose: upright, limbs hanging, the right at +z.
    np.testing.assert_allclose(at["rhip"], [0.0, 0.0, 0.09], atol=1e-3)
    np.testing.assert_allclose(at["rankle"], [0.0, -0.84, 0.09], atol=1e-3)
    np.testing.assert_allclose(at["lshoulder"][[0, 2]], [0.0, -0.17], atol=1e-3)
    np.testing.assert_allclose(at["lshoulder"] - at["lwrist"], [0.0, 0.53, 0.0], atol=1e-3)
    stands = {
        c.get("name"): vector(c, "default_value")
        for c in root.iter("Coordinate")
        if c.find("default_value") is not None
    }
    height = at["rankle"][1] + stands["pelvis_ty"][0]
    assert 0.05 < height < 0.1  # of an ankle above the sole
    if toes:
        foot = at["rtoe"] - at["rankle"]
        np.testing.assert_allclose(height + foot[0] * np.sin(stands["ankle_angle_r"]), 0.0, atol=1e-6)
    bones = {
        frame.get("name").rsplit("_bone")[0]
        for frame in root.iter("PhysicalOffsetFrame")
        if frame.find(".//Ellipsoid") is not None
    }
    assert bones == {body.get("name") for body in root.iter("Body")}
    coordinates = [coordinate.get("name") for coordinate in root.iter("Coordinate")]
    assert len(set(coordinates)) == len(coordinates) == (31 if toes else 29)


def test_without_opensim_the_command_says_how_to_get_it(walker, tmp_path, monkeypatch, capsys):
    save_motion(tmp_path / "motion.npz", walker)
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "opensim" else found(name, *a))
    assert main(["export", str(tmp_path), "--to", "mot"]) == 2
    assert "pip install 'drocap_ros[opensim]'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["motion.npz"]


def test_inverse_kinematics_of_a_simulated_walk_gives_its_angles(walker, tmp_path, monkeypatch, capfd):
    pytest.importorskip("opensim")
    monkeypatch.chdir(tmp_path)
    joints = make_walk(48).shape.copy()
    joints[10:12, BODY_15.index("rwrist")] = np.nan
    joints[20] = np.nan
    save_motion(tmp_path / "motion.npz", dataclasses.replace(walker, joints3d=joints))
    assert main(["export", str(tmp_path), "--to", "mot"]) == 0
    assert "so that the feet stand on it" in capfd.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {"motion.npz", "motion.mot", "motion.osim"}
    assert (tmp_path / "motion.osim").read_text().startswith("<?xml")
    head, table = (tmp_path / "motion.mot").read_text().split("endheader\n")
    assert "inDegrees=yes" in head
    names, *rows = table.splitlines()
    columns = dict(zip(names.split(), np.array([row.split() for row in rows], float).T, strict=True))
    np.testing.assert_allclose(columns["time"], np.arange(48) / 24.0, atol=1e-6)
    phase = 2.0 * np.pi * 0.9 * columns["time"]
    for side, sign in (("l", 1.0), ("r", -1.0)):
        knee = columns[f"knee_angle_{side}"] - np.degrees(0.5 + 0.3 * sign * np.cos(phase))
        hip = columns[f"hip_flexion_{side}"] - np.degrees(0.5 * sign * np.sin(phase))
        assert np.sqrt(np.mean(knee**2)) < 5.0
        assert np.sqrt(np.mean(hip**2)) < 5.0
        assert columns[f"knee_angle_{side}"].min() > -5.0
    assert 0.0 < lowest_ankle_m(columns, tmp_path / "motion.osim") < 0.12


def lowest_ankle_m(columns, model_path):
    """Lowest place of an ankle over the motion, as OpenSim places the model."""
    import opensim

    model = opensim.Model(str(model_path))
    state = model.initSystem()
    heights = []
    for frame in range(len(columns["time"])):
        for coordinate in model.getCoordinateSet():
            value = columns[coordinate.getName()][frame]
            turns = coordinate.getMotionType() == opensim.Coordinate.Rotational
            coordinate.setValue(state, np.radians(value) if turns else value, False)
        model.realizePosition(state)
        heights += [model.getMarkerSet().get(name).getLocationInGround(state).get(1) for name in ("rankle", "lankle")]
    return min(heights)
