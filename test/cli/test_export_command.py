"""``drocap export``: outputs and refused inputs."""

import dataclasses
import re

import numpy as np
import pytest
from export_readers import READERS
from refusals import refused

from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.export import RIGGED, export
from drocap_ros.motion import load_motion, save_motion


@pytest.fixture
def folder(walker, tmp_path):
    save_motion(tmp_path / "motion.npz", walker)
    return tmp_path


@pytest.mark.parametrize("form", READERS)
def test_folder_of_a_motion_is_accepted(folder, form, capsys):
    assert main(["export", str(folder), "--to", form]) == 0
    assert "15 joints" in capsys.readouterr().out
    # A rig has the motion's joints, and those of spine and collar bones.
    assert len(READERS[form](folder / f"motion.{form}").joints) == (21 if form in RIGGED else 15)


def test_names_and_rest_pose_are_chosen_for_rigs_only(folder, capsys):
    out = folder / "rig.bvh"
    options = ["--names", "mixamo", "--rest", "a", "--out", str(out)]
    assert main(["export", str(folder), "--to", "bvh", *options]) == 0
    assert "mixamorig:LeftForeArm" in READERS["bvh"](out).joints
    said = capsys.readouterr().out
    assert "joints moved by" in said
    assert "--names mixamo-three" in said
    options[1] = "mixamo-three"
    assert main(["export", str(folder), "--to", "bvh", *options]) == 0
    # Names that three.js accepts in the path of an animated property: its PropertyBinding reserves [ ] . : /
    assert not re.search(r"(ROOT|JOINT) \S*[\[\].:/]", out.read_text())
    refused(["export", folder, "--to", "trc", "--names", "mixamo"], folder, capsys, "expected with format bvh or glb")


def test_out_names_the_file_and_replaces_it(folder, capsys):
    (folder / "walk.trc").write_text("old")
    assert (
        main(["export", str(folder / "motion.npz"), "--to", "trc", "--out", str(folder / "walk.trc"), "--quiet"]) == 0
    )
    assert (folder / "walk.trc").read_text().startswith("PathFileType\t4\t(X/Y/Z)\twalk.trc\n")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("form", READERS)
def test_times_without_the_person_are_no_measurements(walker, folder, capsys, form):
    confidence = np.ones_like(walker.confidence)
    for unseen in (slice(0, 14), slice(20, 24), slice(34, 48)):  # at 24 Hz; the one in the middle is short
        confidence[unseen] = 0.0
    save_motion(folder / "motion.npz", dataclasses.replace(walker, confidence=confidence))
    assert main(["export", str(folder), "--to", form]) == 0
    assert "28 frames without the person: their poses are" in capsys.readouterr().out
    unknown = np.isnan(READERS[form](folder / f"motion.{form}").positions).all(axis=(1, 2))
    expected = [] if form in RIGGED else [*range(14), *range(34, 48)]
    assert np.flatnonzero(unknown).tolist() == expected
    save_motion(folder / "motion.npz", dataclasses.replace(walker, confidence=0.0 * confidence))
    assert main(["export", str(folder), "--to", form]) == 0
    assert "without the person" not in capsys.readouterr().out
    assert np.isfinite(READERS[form](folder / f"motion.{form}").positions).all()


@pytest.mark.parametrize("form", READERS)
def test_motions_without_content_are_refused(walker, folder, capsys, form):
    nothing = dataclasses.replace(walker, joints3d=np.full_like(walker.joints3d, np.nan))
    save_motion(folder / "nothing.npz", nothing)
    refused(["export", folder / "nothing.npz", "--to", form], folder, capsys, "NaN in all of them")
    one = {f.name: getattr(walker, f.name) for f in dataclasses.fields(walker)}
    one = {k: v[:1] if isinstance(v, np.ndarray) else v for k, v in one.items()}
    save_motion(folder / "one.npz", type(walker)(**one))
    refused(["export", folder / "one.npz", "--to", form], folder, capsys, "at least 2 frames")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parents": np.array([1, 0, *range(13)])}, "one tree"),
        ({"parents": np.full(15, 40)}, "joint indices"),
        ({"parents": np.full(15, -1)}, "one root"),
        ({"parents": np.zeros(15)}, "integers"),
        ({"joints": np.array(["pelvis"] * 15)}, "distinct"),
        ({"joints": np.array([f"joint {i}" for i in range(15)])}, "letters, digits"),
        ({"stamp_ns": np.zeros(48, np.int64)}, "strictly increasing"),
        ({"stamp_ns": np.linspace(0, 1, 48)}, "int64 nanoseconds"),
        ({"stamp_ns": np.arange(47)}, "stamp_ns"),
        ({"joints3d": np.full((48, 15, 3), 1e30)}, "is the unit right"),
        ({"joints3d": np.full((48, 15, 3), np.inf)}, "infinity"),
        ({"joints3d": np.zeros((48, 14, 3))}, "joints3d"),
        ({"joints3d": np.full((48, 15, 3), "a")}, "joints3d"),
        ({"frame": np.array("moon")}, "'world' or 'camera'"),
        ({"meta": np.array("{")}, "JSON"),
    ],
)
def test_damaged_motions_are_refused(folder, capsys, change, words):
    with np.load(folder / "motion.npz") as archive:
        np.savez(folder / "damaged.npz", **{**dict(archive), **change})
    refused(["export", folder / "damaged.npz", "--to", "glb"], folder, capsys, words)


def test_time_line_with_too_many_resampled_frames_is_refused(walker, folder, capsys):
    stamps = walker.stamp_ns.copy()
    stamps[-1] += 10**15
    save_motion(folder / "far.npz", dataclasses.replace(walker, stamp_ns=stamps))
    refused(["export", folder / "far.npz", "--to", "bvh"], folder, capsys, "csv or glb")


def test_skeleton_with_too_many_joints_is_refused(walker, folder, capsys):
    count = 300
    chain = {
        name: np.resize(getattr(walker, name), (48, count, *getattr(walker, name).shape[2:]))
        for name in ("joints3d", "confidence", "keypoints", "reprojection_px")
    }
    names = tuple(f"j{i}" for i in range(count))
    save_motion(
        folder / "chain.npz", dataclasses.replace(walker, **chain, joints=names, parents=tuple(range(-1, count - 1)))
    )
    refused(["export", folder / "chain.npz", "--to", "bvh"], folder, capsys, "at most 255 joints")


def test_refusal_names_a_joint_that_is_never_known(walker, folder, capsys):
    joints = walker.joints3d.copy()
    joints[:, 3] = np.nan
    save_motion(folder / "lame.npz", dataclasses.replace(walker, joints3d=joints))
    for form in ("bvh", "glb"):
        refused(["export", folder / "lame.npz", "--to", form], folder, capsys, "never known: rankle")
    assert main(["export", str(folder / "lame.npz"), "--to", "c3d"]) == 0


def test_too_many_frames_for_c3d_are_refused(walker, folder, capsys):
    many = 70_000
    parts = {
        name: np.resize(getattr(walker, name), (many, *getattr(walker, name).shape[1:]))
        for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px")
    }
    long = dataclasses.replace(walker, **parts, stamp_ns=np.arange(many) * 10_000_000)
    save_motion(folder / "long.npz", long)
    refused(["export", folder / "long.npz", "--to", "c3d"], folder, capsys, "65535 frames")


def test_mutated_motions_are_exported_or_refused_in_one_line(walker, tmp_path):
    """Flipped, cut and replaced bytes: an export or an InputError of one line, no other exception."""
    short = {f.name: getattr(walker, f.name) for f in dataclasses.fields(walker)}
    short = {k: v[:8] if isinstance(v, np.ndarray) else v for k, v in short.items()}
    save_motion(tmp_path / "motion.npz", type(walker)(**short))
    whole = (tmp_path / "motion.npz").read_bytes()
    rng = np.random.default_rng(0)
    refusals: list[str] = []
    for _ in range(150):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(0, 256)
        if rng.random() < 0.2:
            data = data[: rng.integers(1, len(data))]
        (tmp_path / "mutated.npz").write_bytes(data)
        try:
            export(load_motion(tmp_path / "mutated.npz"), tmp_path / "out.bvh", "bvh")
        except InputError as error:
            refusals.append(str(error))
    assert len(refusals) > 75
    assert all(len(text.splitlines()) == 1 for text in refusals)
