"""Truth in the files of motion capture systems: what the package writes reads back, and what others write."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from telemetry_logs import mutated
from walking import write_mocap

from drocap_ros import export
from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.evaluation.compare import compare, load_truth
from drocap_ros.evaluation.truth_files import load_mocap
from drocap_ros.motion import save_motion
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, indices
from lab.studies.protocol import resample

LIMBS = indices(BODY_15.joints, LIMB_JOINTS)


@pytest.fixture
def world(tmp_path, walker):
    save_motion(tmp_path / "motion.npz", walker)
    return walker


@pytest.mark.parametrize("form", ["c3d", "trc"])
def test_measured_positions_read_back(tmp_path, world, form, capsys):
    export(world, tmp_path / f"truth.{form}")
    truth, time_s, frame = load_truth(tmp_path)
    assert frame == "world"
    assert np.abs(truth[:, :15] - world.joints3d[:, :15]).max() < 1e-4
    assert np.abs(time_s - (world.stamp_ns - world.stamp_ns[0]) * 1e-9).max() < 1e-5
    assert main(["evaluate", "compare", str(tmp_path), str(tmp_path / f"truth.{form}")]) == 0
    assert f"| {len(world.joints3d)} | 0.0 |" in capsys.readouterr().out


@pytest.mark.parametrize("names", ["h36m", "lafan1", "mixamo"])
def test_animation_reads_back_to_the_rigid_body(tmp_path, world, names, caplog):
    notes = export(world, tmp_path / "truth.bvh", names=names)
    moved = next(float(n.split("at most ")[1].split(" mm")[0]) for n in notes if n.startswith("bones made constant"))
    floor = next(n for n in notes if n.startswith("floor"))
    lift = float(floor.split(" by ")[1].split(" m")[0]) * (1 if "raised" in floor else -1)
    truth, _, _ = load_truth(tmp_path)
    off = truth[:, LIMBS] - world.joints3d[:, LIMBS] - (0, 0, lift)
    assert 1000 * np.linalg.norm(off, axis=2).max() < moved + 1.0
    assert compare(world, *load_truth(tmp_path)).error_mm < moved + 1.0
    assert "taken as" not in caplog.text


def trc(path, names, x, unit="mm", factor=1000.0, up="y"):
    """A TRC file of positions (F, P, 3) m, z up; empty cells where they are NaN."""
    x = x if up == "z" else x[..., [0, 2, 1]] * (1, 1, -1)
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"24\t24\t{len(x)}\t{len(names)}\t{unit}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(names)) for a in "XYZ"),
    ]
    for i, row in enumerate(x):
        cells = ("" if np.isnan(v) else f"{factor * v:.5f}" for v in row.ravel())
        lines.append(f"{i + 1}\t{i / 24:.6f}\t" + "\t".join(cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def renamed(joint, spelling):
    side, part = ("left", "right")[joint[0] == "r"], joint[1:]
    return spelling(side, part)


RIG = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"}
BLENDER = {
    "hip": "thigh", "knee": "shin", "ankle": "foot", "shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand"
}  # fmt: skip
SPELLINGS = {
    "Pose2Sim": lambda side, part: side[0].upper() + part.capitalize(),
    "SMPL": lambda side, part: f"{side}_{part}",
    "joint centres": lambda side, part: f"Anna:{side[0].upper()}{part[0].upper()}JC",
    "Blender": lambda side, part: f"{BLENDER[part]}.{side[0].upper()}",
}


def test_a_file_of_another_library_reads_in_its_units_and_axes(tmp_path, world):
    """Metres, y up, one point lost for some frames, analogue data and a point that is no joint."""
    import ezc3d

    x = np.concatenate([world.joints3d[:, :15], world.joints3d[:, :1]], axis=1)[..., [0, 2, 1]] * (1, 1, -1)
    points = np.ones((4, 16, len(x)))
    points[:3] = x.transpose(2, 1, 0)
    points[:3, 5, 10:14] = np.nan
    c = ezc3d.c3d()
    c["parameters"]["POINT"]["RATE"]["value"] = [24]
    c["parameters"]["POINT"]["LABELS"]["value"] = (*BODY_15.joints, "CLAV")
    c["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    c["parameters"]["ANALOG"]["RATE"]["value"] = [240]
    c["parameters"]["ANALOG"]["LABELS"]["value"] = ("force",)
    c["data"]["points"], c["data"]["analogs"] = points, np.zeros((1, 1, 10 * len(x)))
    c.write(str(tmp_path / "truth.c3d"))
    truth, _, _ = load_truth(tmp_path)
    known = np.isfinite(truth[:, :15]).all(axis=2)
    assert np.argwhere(~known).tolist() == [[i, 5] for i in range(10, 14)]
    assert np.abs(truth[:, :15] - world.joints3d[:, :15])[known].max() < 1e-5
    assert compare(world, *load_truth(tmp_path)).world.absolute_mm < 0.1


@pytest.mark.parametrize("spelling", SPELLINGS.values(), ids=SPELLINGS)
def test_joints_are_known_by_the_names_of_others(tmp_path, world, spelling):
    names = [renamed(joint, spelling) for joint in LIMB_JOINTS]
    path = trc(tmp_path / "truth.trc", names, world.joints3d[:, LIMBS])
    assert compare(world, *load_truth(path)).error_mm < 0.1


def test_the_clavicle_of_a_rig_is_no_shoulder(tmp_path, world):
    names = [renamed(joint, lambda side, part: side.capitalize() + RIG[part]) for joint in LIMB_JOINTS]
    names.append("LeftShoulder")
    path = trc(tmp_path / "truth.trc", names, world.joints3d[:, [*LIMBS, 0]])
    assert compare(world, *load_truth(path)).error_mm < 0.1


@pytest.mark.parametrize(
    ("unit", "factor", "up", "said"),
    [
        ("m", 1.0, "y", ""),
        ("cm", 0.45 / 0.0254, "y", "taken as in/0.45"),
        ("cm", 1 / 0.0254, "y", "taken as in"),
        ("mm", 1.0, "y", "taken as m"),
        ("mm", 1000.0, "z", "taken as Z up"),
        ("cm", 100.0, "y", ""),
    ],
)
def test_units_and_vertical_fit_the_body_or_are_corrected_in_a_line(tmp_path, world, caplog, unit, factor, up, said):
    path = trc(tmp_path / "truth.trc", list(BODY_15.joints), world.joints3d[:, :15], unit, factor, up)
    errors = compare(world, *load_truth(path))
    assert errors.world.absolute_mm < 0.1
    assert caplog.text.count("taken as") == bool(said)
    assert said in caplog.text


@pytest.mark.parametrize("lost", [np.nan, 0.0])
def test_frames_in_gaps_of_the_truth_are_left_out(tmp_path, world, caplog, capsys, lost):
    x = world.joints3d[:, :15].copy()
    x[10:15, 3] = lost
    path = trc(tmp_path / "truth.trc", list(BODY_15.joints), x)
    assert main(["evaluate", "compare", str(tmp_path), str(path)]) == 0
    assert "gaps of the truth: left out" in caplog.text
    frames = int(capsys.readouterr().out.splitlines()[2].split("|")[2])
    assert 5 <= len(x) - frames <= 7


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Zrotation\n}\nMOTION\nFrames: 9\nFrame Time: 0.1\n", "whole"),
        (b"HIERARCHY\nROOT Hips", "expected a BVH file that can be read"),
        (b"PathFileType\t4\n", "row Frame#"),
        (b"\x02\x50" + b"\0" * 600, "expected a C3D file"),
        (b"a,b\n1,2\n", "expected"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, world, capsys, content, words):
    (tmp_path / "truth.bin").write_bytes(content)
    assert main(["evaluate", "compare", str(tmp_path), str(tmp_path / "truth.bin")]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_markers_of_other_places_are_named(tmp_path, world):
    path = trc(tmp_path / "truth.trc", ["LASI", "RASI", "C7"], world.joints3d[:, :3])
    with pytest.raises(InputError, match=r"found no rhip.* among LASI, RASI, C7; rename"):
        load_truth(path)


@pytest.mark.parametrize("prefix", ["", "Subject1:", "jim_"])
def test_a_file_of_skin_markers_alone_is_refused_in_words(tmp_path, world, prefix):
    names = ["LASI", "RASI", "LKNE", "RKNE", "LANK", "RANK", "LTOE", "RTOE", "C7", "LSHO", "RSHO", "LELB", "RELB"]
    path = trc(tmp_path / "truth.trc", [prefix.replace("_", "|") + name for name in names], world.joints3d[:, :13])
    with pytest.raises(InputError, match="expected joint centres, found markers on the skin"):
        load_truth(path)


@pytest.mark.parametrize("names", [["Anna", "Ben"], ["s1", "s2", "s3"]])
def test_one_of_several_bodies_is_named_and_another_chosen(tmp_path, world, names, caplog):
    x = world.joints3d[:, LIMBS]
    both = np.concatenate([x + np.array([2.0 * i, 0, 0]) for i in range(len(names))], axis=1)
    both[:5, : len(LIMBS)] = np.nan  # of the first body
    path = trc(tmp_path / "truth.trc", [f"{name}:{joint}" for name in names for joint in LIMB_JOINTS], both)
    first, second = load_truth(path)[0], load_truth(f"{path}#{names[0]}")[0]
    assert f"several bodies, {', '.join(names)}: {names[1]} is used" in caplog.text
    assert np.allclose(first[5:, LIMBS] - second[5:, LIMBS], [2.0, 0, 0], atol=1e-5)
    with pytest.raises(InputError, match="expected a body named 'Eve'"):
        load_truth(f"{path}#Eve")


@pytest.mark.parametrize("name", ["truth.fbx", "truth.csv", "truth.mp4", "truth"])
def test_a_truth_of_another_kind_names_those_that_are_read(tmp_path, name):
    (tmp_path / name).write_bytes(b"Kaydara FBX Binary  \x00\x1a\x00")
    with pytest.raises(InputError, match="expected a truth as MoCap"):
        load_truth(tmp_path / name)


@pytest.mark.parametrize("form", ["c3d", "trc", "bvh"])
def test_mocap_is_read_in_every_form_of_a_truth(tmp_path, world, form):
    from lab.studies.protocol import mocap_files

    export(world, tmp_path / f"take.{form}")
    (path,) = mocap_files(tmp_path, "take")
    x, fps = load_mocap(path, joints=BODY_17)
    truth, time_s, _ = load_truth(path)
    assert np.allclose(x / 1000, truth, equal_nan=True)
    assert fps == pytest.approx(1 / np.median(np.diff(time_s)))


@pytest.mark.parametrize("form", ["c3d", "trc", "bvh"])
def test_damaged_files_give_a_truth_or_one_line(tmp_path, world, form):
    export(world, tmp_path / f"truth.{form}")
    whole, rng = (tmp_path / f"truth.{form}").read_bytes(), random.Random(3)
    for _ in range(40):
        (tmp_path / f"truth.{form}").write_bytes(mutated(whole, rng))
        try:
            truth, time_s, _ = load_truth(tmp_path / f"truth.{form}")
            assert truth.shape == (len(time_s), 17, 3)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_resampling_keeps_the_motion() -> None:
    t = np.arange(91) / 30.0
    x = np.sin(t)[:, None, None] * np.ones((1, 15, 3))
    out = resample(x, 30.0, 24.0)
    assert len(out) == 73
    np.testing.assert_allclose(out[:, 0, 0], np.sin(np.arange(73) / 24.0), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"X": np.zeros((4, 3, 3))}, r"X: expected \(T, 15, 3\)"),
        ({"fps": np.array(0.0)}, "fps: expected a number from 1 to 1000"),
        ({"fps": np.array("abc")}, "fps: expected a number from 1 to 1000"),
        ({"fps": np.array([30.0, 30.0])}, "fps: expected a number from 1 to 1000"),
        ({"joints": np.array(["a"] * 15)}, "bad.npz: .*missing pelvis"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, changes: dict[str, np.ndarray], match: str) -> None:
    write_mocap(tmp_path, "bad", frames=200, **changes)
    with pytest.raises(InputError, match=match):
        load_mocap(tmp_path / "bad.npz")


@pytest.mark.parametrize("kind", ["tip", "ball"])
def test_toes_are_read_where_they_are_tips(tmp_path: Path, kind: str) -> None:
    left, right = np.full((90, 3), 1.0), np.full((90, 3), 2.0)
    further = {"toes": np.stack([left, right], axis=1), "toe_joints": np.array(["ltoe", "rtoe"])}
    write_mocap(tmp_path, "toes", frames=90, toe_kind=np.array(kind), **further)
    x, fps = load_mocap(tmp_path / "toes.npz", joints=BODY_17)
    expected = np.stack([right, left], axis=1) if kind == "tip" else np.full((90, 2, 3), np.nan)
    np.testing.assert_array_equal(x[:, 15:], expected)
    np.testing.assert_array_equal(load_mocap(tmp_path / "toes.npz")[0], x[:, :15])
    resampled = resample(x, fps, 0.5 * fps)
    assert np.isfinite(resampled[:, :15]).all()
    assert np.isfinite(resampled[:, 15:]).all() == (kind == "tip")
