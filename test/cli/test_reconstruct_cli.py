"""``drocap reconstruct`` as a process: real videos, tracks files, unusable input."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.evaluation.metrics import aligned_error
from drocap_ros.motion import load_motion
from drocap_ros.simulation.capture import simulate_capture
from drocap_ros.skeleton import LIMB_JOINTS, indices
from drocap_ros.tracks import save_tracks

ROOT = Path(__file__).resolve().parents[2]

#: BlazePose-33's places of the 12 limb joints, in the order of LIMB_JOINTS.
BLAZEPOSE = [24, 26, 28, 23, 25, 27, 11, 13, 15, 12, 14, 16]


def drocap(*arguments, cwd, **env):
    # The environment of the test run must not reach the command.
    clean = {k: v for k, v in os.environ.items() if k not in ("DROCAP_MODELS", "DROCAP_DEBUG")}
    clean["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-m", "drocap_ros.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=900, env={**clean, **env})


def reconstructed(path, cwd, *options):
    done = drocap("reconstruct", path, "--out", "out", *options, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return load_motion(cwd / "out" / "motion.npz")


def assert_refused(done, cwd, words):
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert "Traceback" not in done.stderr
    assert not (cwd / "out").exists()
    assert not list(cwd.glob(".out*"))


@pytest.fixture
def tracks_file(tmp_path):
    capture = simulate_capture(3.0, 24.0, seed=3)
    save_tracks(tmp_path / "tracks.npz", capture.tracks)
    return tmp_path / "tracks.npz"


def changed(path, **arrays):
    with np.load(path) as archive:
        values = {**dict(archive), **arrays}
    np.savez(path.parent / "changed.npz", **{k: v for k, v in values.items() if v is not None})
    return path.parent / "changed.npz"


@pytest.fixture(scope="module")
def outdoor_walk(shared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("outdoor_walk")
    return reconstructed(shared / "media" / "outdoor_walk.mp4", folder, "--models", shared / "models")


def test_outdoor_walk_gives_an_upright_motion_of_every_frame(outdoor_walk):
    motion = outdoor_walk
    assert motion.joints3d.shape == (230, 17, 3)
    assert motion.joints3d.dtype == np.float64
    assert motion.frame == "world"
    assert motion.meta["camera"]["kind"] == "stands"
    assert motion.meta["lens"] == "assumed"
    seen = np.isfinite(motion.keypoints).all(axis=2)
    assert seen.any(axis=1).mean() >= 0.95
    head, feet = (motion.joints3d[:, indices(motion.joints, names), 2] for names in (("head",), ("rankle", "lankle")))
    # He jumps off a roof backwards and turns over in the air: his head is below his feet in images 175 to 177.
    upright = (feet < head).all(axis=1)
    assert upright[:170].all()
    assert not upright[175:178].any()
    assert upright[182:].all()
    assert set(motion.meta["seconds"]) >= {"pose2d", "initial", "ba"}
    assert motion.meta["iterations"] > 0
    assert motion.meta["stop_reason"]


@pytest.mark.parametrize("side", ["r", "l"])
def test_the_knees_of_outdoor_walk_bend_as_the_legs_shorten_in_the_image(outdoor_walk, side):
    leg = indices(outdoor_walk.joints, (f"{side}hip", f"{side}knee", f"{side}ankle"))
    bones = np.diff(outdoor_walk.joints3d[:, leg], axis=1)
    cosine = (bones[:, 0] * bones[:, 1]).sum(axis=1) / np.linalg.norm(bones, axis=2).prod(axis=1)
    flexion = np.degrees(np.arccos(cosine))
    # He does jumping jacks in the first 75 images, seen from the front: both bones of a leg lean alike.
    length = np.linalg.norm(np.diff(outdoor_walk.keypoints[:75, leg], axis=1), axis=2).sum(axis=1)
    expected = 2 * np.degrees(np.arccos(np.minimum(length / np.quantile(length, 0.95), 1)))
    print(f"{side} knee, jumping: {np.median(flexion[:75]):.0f} degrees, by the leg's length {np.median(expected):.0f}")
    print(f"{side} knee, walking: {np.median(flexion[100:140]):.0f} degrees")
    assert np.corrcoef(flexion[:75], expected)[0, 1] > 0.75
    assert abs(np.median(flexion[:75]) - np.median(expected)) < 15
    # Then he turns to the side and walks on, upright.
    assert np.median(flexion[100:140]) < 25


def test_squats_agree_with_another_system(shared, tmp_path):
    motion = reconstructed(shared / "media" / "pose_squats.mp4", tmp_path, "--models", shared / "models")
    assert np.isfinite(motion.keypoints).all(axis=2).any(axis=1).mean() >= 0.95
    landmarks = json.loads((shared / "media" / "pose_squats_landmarks3d.json").read_text())
    other = np.array(landmarks, float)[: len(motion.joints3d), BLAZEPOSE, :3]
    ours = motion.joints3d[:, indices(motion.joints, LIMB_JOINTS)]
    # Another estimate, not a truth: agreement within 130 mm excludes mirrored and exchanged joints.
    error = 1000 * aligned_error(ours, other).mean()
    print(f"pose_squats.mp4 against the other system's landmarks, 12 limb joints: {error:.1f} mm")
    assert error < 130


def test_same_input_gives_the_same_arrays(tracks_file, tmp_path):
    first = reconstructed(tracks_file, tmp_path)
    (tmp_path / "again").mkdir()
    second = reconstructed(tracks_file, tmp_path / "again")
    for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px", "stamp_ns"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


@pytest.mark.parametrize("method", ["ba", "paper", "paper-no-articulation", "initial", "mf-nnm"])
def test_every_method_runs_on_tracks(tracks_file, tmp_path, method):
    motion = reconstructed(tracks_file, tmp_path, "--method", method)
    assert motion.frame == "world"
    assert np.isfinite(motion.joints3d).all()
    assert motion.meta["method"] == method
    assert "<canvas" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_one_frame_gives_a_pose(tracks_file, tmp_path):
    capture = simulate_capture(0.05, 20.0, seed=1)
    save_tracks(tmp_path / "one.npz", capture.tracks)
    motion = reconstructed(tmp_path / "one.npz", tmp_path)
    assert motion.joints3d.shape == (1, 17, 3)
    assert np.isfinite(motion.joints3d).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"keypoints": np.zeros((72, 15))}, "keypoints: expected float (F, P, 2)"),
        ({"keypoints": np.full((72, 15, 2), np.nan)}, "keypoints"),
        ({"joints": None}, "expected points with names"),
        ({"joints": np.array([f"j{i}" for i in range(15)])}, "joints: expected at least 4"),
        ({"covariance": np.full((72, 15, 3), -1.0)}, "covariance"),
    ],
)
def test_unusable_tracks_are_refused(tracks_file, tmp_path, change, words):
    path = changed(tracks_file, **change)
    assert_refused(drocap("reconstruct", path, "--out", "out", cwd=tmp_path), tmp_path, words)


def test_files_without_a_video_are_refused(tmp_path):
    (tmp_path / "text.mp4").write_text("This is not a video.\n" * 50)
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "folder").mkdir()
    for name, words in (
        ("none.mp4", "no such file"),
        ("text.mp4", "text.mp4"),
        ("empty.mp4", "empty.mp4"),
        ("folder", "folder"),
    ):
        assert_refused(drocap("reconstruct", name, "--out", "out", cwd=tmp_path), tmp_path, words)


def test_truncated_video_is_refused(shared, tmp_path):
    data = (shared / "media" / "pose_squats.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    done = drocap("reconstruct", "cut.mp4", "--models", shared / "models", "--out", "out", cwd=tmp_path)
    assert_refused(done, tmp_path, "cut.mp4")


def test_models_folder_without_a_pose_model_is_refused(shared, tmp_path):
    models = tmp_path / "models"
    models.mkdir()
    for names in ((), ("rtmdet-nano.onnx",)):
        for name in names:
            (models / name).symlink_to(shared / "models" / name)
        video = shared / "media" / "pose_squats.mp4"
        done = drocap("reconstruct", video, "--models", models, "--out", "out", cwd=tmp_path)
        assert_refused(done, tmp_path, "drocap models fetch")


def test_unwritable_output_is_refused_before_the_work(tracks_file, tmp_path):
    (tmp_path / "file").touch()
    done = drocap("reconstruct", tracks_file, "--out", "file", cwd=tmp_path)
    assert done.returncode == 2
    assert "expected a folder" in done.stderr


def test_every_listed_command_has_a_help_text(tmp_path):
    done = drocap("--help", cwd=tmp_path)
    assert done.returncode == 0
    commands = set(re.findall(r"^    ([a-z][a-z-]+)", done.stdout, re.MULTILINE))
    assert commands >= {"demo", "live", "record", "reconstruct", "info", "models", "learn-dictionary"}
    for command in commands:
        assert drocap(command, "--help", cwd=tmp_path).returncode == 0
