"""``--camera-pitch`` and ``--camera-roll``: the attitude of a camera that stands still."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.motion import load_motion
from drocap_ros.recording.video_telemetry import with_attitude
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.tracks import Tracks, save_tracks


def tracks() -> Tracks:
    person = simulate_person(np.arange(60) / 24.0, action="walk", seed=0)
    person = person - person[:, :1]
    stamps = np.round(np.arange(60) * (1e9 / 24.0)).astype(np.int64)
    names = ("pelvis", "rhip", "rknee", "rankle", "lhip", "lknee", "lankle", "neck", "head")
    names += ("lshoulder", "lelbow", "lwrist", "rshoulder", "relbow", "rwrist")
    flat = 300.0 * np.stack([person[:, :15, 0], -person[:, :15, 2]], axis=-1) + [640.0, 360.0]
    return Tracks(flat, names, stamps, (1280, 720))


def test_pitch_and_roll_give_the_rotation_of_a_camera_that_looks_down_and_is_turned_clockwise() -> None:
    rotation = with_attitude(tracks(), (-30.0, 0.0)).camera_rotation
    assert rotation is not None
    forward, right, down = rotation[0, 2], rotation[0, 0], rotation[0, 1]
    np.testing.assert_allclose(forward, [0.0, np.cos(np.pi / 6), -0.5], atol=1e-12)
    np.testing.assert_allclose(right, [1.0, 0.0, 0.0], atol=1e-12)
    assert down[2] < 0.0
    rolled = with_attitude(tracks(), (-30.0, 20.0)).camera_rotation
    assert rolled is not None
    np.testing.assert_allclose(rolled[0, 2], forward, atol=1e-12)
    assert rolled[0, 0, 2] == pytest.approx(-np.sin(np.deg2rad(20.0)) * np.cos(np.pi / 6))  # the right side is lower


def test_the_command_gives_a_motion_with_gravity(tmp_path: Path) -> None:
    save_tracks(tmp_path / "tracks.npz", tracks())
    options = ["--out", str(tmp_path / "out"), "--no-report", "--quiet", "--camera-pitch", "-10"]
    assert main(["reconstruct", str(tmp_path / "tracks.npz"), *options]) == 0
    motion = load_motion(tmp_path / "out" / "motion.npz")
    assert (motion.frame, motion.metric) == ("world", False)
    head, ankle = (motion.joints3d[:, motion.joints.index(name), 2].mean() for name in ("head", "rankle"))
    assert head > ankle + 1.0


def test_impossible_and_needless_angles_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = with_attitude(tracks(), (0.0, 0.0))
    save_tracks(tmp_path / "known.npz", known)
    save_tracks(tmp_path / "tracks.npz", tracks())
    for name, options, words in (
        ("tracks.npz", ["--camera-pitch", "-120"], "--camera-pitch: expected -90 to 90 deg, got -120"),
        ("tracks.npz", ["--camera-roll", "nan"], "--camera-roll: expected -180 to 180 deg"),
        ("known.npz", ["--camera-roll", "5"], "found the camera's attitude"),
    ):
        command = ["reconstruct", str(tmp_path / name), "--out", str(tmp_path / "out"), "--quiet", *options]
        assert main(command) == 2
        assert words in capsys.readouterr().err
