"""``drocap reconstruct``: real videos, tracks files, unusable input."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from refusals import refused

from drocap_ros.cli import main
from drocap_ros.evaluation.metrics import aligned_error
from drocap_ros.motion import load_motion
from drocap_ros.perception.sources.video import VideoSource
from drocap_ros.skeleton import LIMB_JOINTS, indices
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture

#: BlazePose-33's places of the 12 limb joints, in the order of LIMB_JOINTS.
BLAZEPOSE = [24, 26, 28, 23, 25, 27, 11, 13, 15, 12, 14, 16]


def reconstructed(path, folder, *options):
    assert main(["reconstruct", str(path), "--out", str(folder / "out"), *map(str, options)]) == 0
    return load_motion(folder / "out" / "motion.npz")


def assert_refused(path, folder, capfd, words, *options):
    """Libraries in C write to the process's own error output: it has one line, too."""
    refused(["reconstruct", path, "--out", folder / "out", *options], folder, capfd, words)


@pytest.fixture
def tracks_file(tmp_path):
    capture = simulate_capture(3.0, 24.0, seed=3)
    save_tracks(tmp_path / "tracks.npz", capture.tracks)
    return tmp_path / "tracks.npz"


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


def knee(motion, side):
    """Hip, knee and ankle, and the knee's flexion (F,) deg."""
    leg = indices(motion.joints, (f"{side}hip", f"{side}knee", f"{side}ankle"))
    bones = np.diff(motion.joints3d[:, leg], axis=1)
    cosine = (bones[:, 0] * bones[:, 1]).sum(axis=1) / np.linalg.norm(bones, axis=2).prod(axis=1)
    return leg, np.degrees(np.arccos(cosine))


_BENT = pytest.mark.xfail(reason="28 degrees since still cameras are adjusted, 24 before", strict=True)


@pytest.mark.parametrize("side", [pytest.param("r", marks=_BENT), "l"])
def test_the_knees_of_outdoor_walk_are_nearly_straight_where_he_turns_to_the_side_and_walks(outdoor_walk, side):
    assert np.median(knee(outdoor_walk, side)[1][100:140]) < 25


@pytest.mark.parametrize("side", ["r", "l"])
def test_the_knees_of_outdoor_walk_bend_as_the_legs_shorten_in_the_image(outdoor_walk, side):
    leg, flexion = knee(outdoor_walk, side)
    # He does jumping jacks in the first 75 images, seen from the front: both bones of a leg lean alike.
    length = np.linalg.norm(np.diff(outdoor_walk.keypoints[:75, leg], axis=1), axis=2).sum(axis=1)
    expected = 2 * np.degrees(np.arccos(np.minimum(length / np.quantile(length, 0.95), 1)))
    print(f"{side} knee, jumping: {np.median(flexion[:75]):.0f} degrees, by the leg's length {np.median(expected):.0f}")
    assert np.corrcoef(flexion[:75], expected)[0, 1] > 0.75
    assert abs(np.median(flexion[:75]) - np.median(expected)) < 15


def test_squats_agree_with_another_system(shared, tmp_path, monkeypatch):
    asked: list[VideoSource] = []
    read = VideoSource.read
    monkeypatch.setattr(VideoSource, "read", lambda source: asked.append(source) or read(source))
    motion = reconstructed(shared / "media" / "pose_squats.mp4", tmp_path, "--models", shared / "models")
    assert np.isfinite(motion.keypoints).all(axis=2).any(axis=1).mean() >= 0.95
    # The report shows the pictures of the video, which was decoded once.
    assert len(asked) < 2 * 65
    assert (tmp_path / "out" / "report.html").read_text().count('"/9j/') == 65
    landmarks = json.loads((shared / "media" / "pose_squats_landmarks3d.json").read_text())
    other = np.array(landmarks, float)[: len(motion.joints3d), BLAZEPOSE, :3]
    ours = motion.joints3d[:, indices(motion.joints, LIMB_JOINTS)]
    # Another estimate, not a truth: agreement within 130 mm excludes mirrored and exchanged joints.
    error = 1000 * aligned_error(ours, other).mean()
    print(f"pose_squats.mp4 against the other system's landmarks, 12 limb joints: {error:.1f} mm")
    assert error < 130


def test_same_input_gives_the_same_arrays_in_another_process(tracks_file, tmp_path, root):
    first = reconstructed(tracks_file, tmp_path)
    again = tmp_path / "again"
    command = [sys.executable, "-m", "drocap_ros.cli", "reconstruct", tracks_file, "--out", again, "--no-report"]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(root)})
    second = load_motion(again / "motion.npz")
    for name in ("joints3d", "camera_rotation", "confidence", "keypoints", "reprojection_px", "stamp_ns"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_files_without_a_video_are_refused(tmp_path, capfd):
    (tmp_path / "text.mp4").write_text("This is not a video.\n" * 50)
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "folder").mkdir()
    for name, words in (
        ("none.mp4", "no such file"),
        ("text.mp4", "text.mp4"),
        ("empty.mp4", "empty.mp4"),
        ("folder", "folder"),
    ):
        assert_refused(tmp_path / name, tmp_path, capfd, words)


def test_truncated_video_is_refused(root, shared, tmp_path):
    """In a process of its own: OpenCV takes the level of FFmpeg's messages from the first video of a process."""
    data = (shared / "media" / "pose_squats.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    command = [sys.executable, "-m", "drocap_ros.cli", "reconstruct", tmp_path / "cut.mp4", "--out", tmp_path / "out"]
    command += ["--models", shared / "models"]
    run = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(root)})
    assert run.returncode == 2
    assert len(run.stderr.strip().splitlines()) == 1
    assert "cut.mp4" in run.stderr
    assert not (tmp_path / "out").exists()


def test_models_folder_without_a_pose_model_is_refused(shared, tmp_path, capfd):
    models = tmp_path / "models"
    models.mkdir()
    for names in ((), ("rtmdet-nano.onnx",)):
        for name in names:
            (models / name).symlink_to(shared / "models" / name)
        video = shared / "media" / "pose_squats.mp4"
        assert_refused(video, tmp_path, capfd, "drocap models fetch", "--models", models)
