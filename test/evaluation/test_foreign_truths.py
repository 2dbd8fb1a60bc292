"""A truth as other programs spell it: numbers, heads, lost points, names of rigs, units."""

import numpy as np
import pytest

from drocap_ros.evaluation.compare import load_truth
from drocap_ros.evaluation.truth_files import body_joints
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, indices

LIMBS = indices(BODY_17.joints, LIMB_JOINTS)
WORLD = simulate_person(np.arange(0, 2, 1 / 24), "walk", 0, joint_set=BODY_17)


PLAIN = {
    "separator": "\t", "point": ".", "frame": "Frame#", "units": "mm", "factor": 1000.0, "sub": True, "blank": True,
    "together": False, "newline": "\n", "lost": "0",
}  # fmt: skip
LOST = [(3, 5), (7, 5)]  # frames and joint


def trc(path, *, gaps=(), **spelling):
    how = {**PLAIN, **spelling}
    names, separator, between = BODY_17.joints, how["separator"], 1 if how["together"] else 3
    lines = [
        separator.join(["PathFileType", "4", "(X/Y/Z)", "x.trc"]),
        separator.join(["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]),
        separator.join(["24", "24", str(len(WORLD)), str(len(names)), how["units"]]),
        how["frame"] + separator + "Time" + separator + (separator * between).join(names),
        *[separator * 2 + separator.join(f"{a}{i + 1}" for i in range(len(names)) for a in "XYZ")] * how["sub"],
        *[""] * how["blank"],
    ]
    for i, row in enumerate(WORLD[..., [0, 2, 1]] * (1, 1, -1)):
        numbers = [f"{i / 24:.6f}", *(f"{how['factor'] * v:.5f}" for v in row.ravel())]
        cells = [number.replace(".", how["point"]) for number in numbers]
        cells[1:] = [how["lost"] if (i, j // 3) in gaps else cell for j, cell in enumerate(cells[1:])]
        lines.append(separator.join([str(i + 1), *cells]))
    path.write_text(how["newline"].join(lines) + how["newline"])
    return path


@pytest.mark.parametrize(("separator", "point"), [("\t", "."), ("\t", ","), (" ", ".")])
@pytest.mark.parametrize("head", [
    {}, {"frame": "frame#"}, {"frame": "Frame"}, {"sub": False}, {"sub": False, "blank": False}, {"blank": False},
    {"together": True}, {"newline": "\r\n"}, {"units": "m", "factor": 1.0}, {"units": "Meters", "factor": 1.0},
])  # fmt: skip
@pytest.mark.parametrize("lost", [None, "", "nan", "0.0", "9999999", "-9999"])
def test_a_trc_is_read_in_every_spelling(tmp_path, separator, point, head, lost):
    if separator == " " and lost == "":
        return  # an empty cell cannot be told from the space
    gaps = LOST if lost is not None else ()
    spelling = {"separator": separator, "point": point, "lost": lost, **head}
    truth, time_s, _ = load_truth(trc(tmp_path / "x.trc", gaps=gaps, **spelling))
    assert len(truth) == len(WORLD)
    assert np.diff(time_s) == pytest.approx(1 / 24, abs=1e-5)
    known = np.isfinite(truth).all(axis=2)
    assert np.argwhere(~known).tolist() == [list(gap) for gap in gaps]
    assert np.abs(truth - WORLD)[known].max() < 1e-4


RIGS = {
    "mixamo": ("UpLeg Leg Foot Arm ForeArm Hand", lambda s, p: f"mixamorig:{s}{p}"),
    "three.js": ("UpLeg Leg Foot Arm ForeArm Hand", lambda s, p: f"mixamorig{s}{p}"),
    "Maya": ("UpLeg Leg Foot Arm ForeArm Hand", lambda s, p: f"Character1_{s}{p}"),
    "Biped": ("Thigh Calf Foot UpperArm Forearm Hand", lambda s, p: f"Bip01 {s[0]} {p}"),
    "Valve": ("Thigh Calf Foot UpperArm Forearm Hand", lambda s, p: f"ValveBiped.Bip01_{s[0]}_{p}"),
    "Reallusion": ("Thigh Calf Foot Upperarm Forearm Hand", lambda s, p: f"CC_Base_{s[0]}_{p}"),
    "VRM": ("UpperLeg LowerLeg Foot UpperArm LowerArm Hand", lambda s, p: f"J_Bip_{s[0]}_{p}"),
    "Rigify": ("thigh shin foot upper_arm forearm hand", lambda s, p: f"DEF-{p}.{s[0]}"),
    "Unreal": ("thigh calf foot upperarm lowerarm hand", lambda s, p: f"{p}_{s[0].lower()}"),
    "DAZ": ("ThighBend Shin Foot ShldrBend ForearmBend Hand", lambda s, p: f"{s[0].lower()}{p}"),
    "Poser": ("Thigh Shin Foot Shldr ForeArm Hand", lambda s, p: f"{s[0].lower()}{p}"),
    "Xsens": ("UpperLeg LowerLeg Foot UpperArm LowerArm Hand", lambda s, p: f"{s}{p}"),
    "SMPL": ("hip knee ankle shoulder elbow wrist", lambda s, p: f"{s.lower()}_{p}"),
}  # fmt: skip
#: Names that are no limb joint, in rigs beside them.
OTHERS = ("{}Twist", "{}Toe0", "{}Clavicle", "{}Shoulder_helper", "{}HandThumb1", "{}UpLegRoll", "{}Eye", "{}Breast")


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS)
@pytest.mark.parametrize("others_first", [False, True])
def test_joints_of_rigs_are_known_by_the_names_behind_a_prefix(rig, others_first):
    words, spelled = rig
    parts = dict(zip(("hip", "knee", "ankle", "shoulder", "elbow", "wrist"), words.split(), strict=True))
    joints = {f"{s[0].lower()}{part}": spelled(s, word) for s in ("Left", "Right") for part, word in parts.items()}
    middle = [spelled("L", "x").replace("L", "C"), "Root", "Hips", "Neck"]
    others = [spelled(s, other.format("")) for s in ("Left", "Right") for other in OTHERS]
    names = [*middle, *others, *joints.values()] if others_first else [*joints.values(), *middle, *others]
    found = body_joints(names)
    assert {joint: names[found[joint]] for joint in joints} == joints


@pytest.mark.parametrize(("factor", "said"), [(1000.0, ""), (1.0, "taken as m"), (100.0, "taken as cm"), (0.01, "")])
def test_the_unit_of_mocap_fits_the_body(tmp_path, caplog, factor, said):
    np.savez(tmp_path / "x.npz", X=factor * WORLD[:, :15], fps=24, joints=np.array(BODY_15.joints))
    truth, _, _ = load_truth(tmp_path / "x.npz")
    assert said in caplog.text
    assert bool(said) == bool(caplog.text)
    if factor >= 1:
        assert np.abs(truth - WORLD)[:, LIMBS].max() < 1e-9


def test_mocap_that_stands_along_another_axis_is_told_and_not_turned(tmp_path, caplog):
    turned = 1000 * WORLD[:, :15][..., [0, 2, 1]] * (1, 1, -1)
    np.savez(tmp_path / "x.npz", X=turned, fps=24, joints=np.array(BODY_15.joints))
    truth, _, _ = load_truth(tmp_path / "x.npz")
    assert "along Y" in caplog.text
    assert np.abs(1000 * truth[:, :15] - turned).max() < 1e-6


@pytest.mark.parametrize("point", [".", ","])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_a_bvh_is_read_in_every_spelling(tmp_path, point, newline, mark):
    names = [name for name in BODY_17.joints if name != "pelvis"]
    lines = ["HIERARCHY", "ROOT pelvis", "{", "OFFSET 0 0 0", "CHANNELS 3 Xposition Yposition Zposition"]
    for name in names:
        lines += [f"JOINT {name}", "{", "OFFSET 0.5 0 0", "CHANNELS 3 Xposition Yposition Zposition", "End Site", "{",
                  "OFFSET 0 1 0", "}", "}"]  # fmt: skip
    lines += ["}", "MOTION", f"Frames: {len(WORLD)}", f"Frame Time: {1 / 24:.7f}"]
    cm = 100 * WORLD[..., [0, 2, 1]] * (1, 1, -1)
    for root, *joints in cm[:, [0, *range(1, 17)]]:
        lines.append(" ".join(f"{v:.5f}" for v in (*root, *(np.array(joints) - root).ravel())))
    (tmp_path / "x.bvh").write_bytes((mark + newline.join(lines).replace(".", point)).encode())
    truth, time_s, _ = load_truth(tmp_path / "x.bvh")
    assert np.abs(truth - WORLD)[:, LIMBS].max() < 1e-4
    assert np.diff(time_s) == pytest.approx(1 / 24, rel=1e-5)
