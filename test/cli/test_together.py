"""``drocap reconstruct A B --together``: two recordings of one person whose times and places nobody knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.corrections import save_corrections
from drocap_ros.evaluation.metrics import aligned_error, pa_mpjpe
from drocap_ros.motion import load_motion
from drocap_ros.simulation.pinhole import pinhole_matrix, project
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_17, other_side
from drocap_ros.tracks import Tracks, load_tracks, save_tracks
from lab.simulation.orbit import orbit_camera
from lab.studies.world_scene import PinholePath, followed_points

SIZE, FPS, FRAMES = (1280, 720), 30.0, 240
#: s by which the second recording starts later; its clock is another one.
LATER_S = 0.81
_CLOCK_NS = 1_700_000_000_000_000_000


def truth(time_s: np.ndarray, action: str = "mixed") -> np.ndarray:
    return simulate_person(time_s, action, 1, 1.75, BODY_17)


def seen_from(
    bearing_deg: float, time_s: np.ndarray, action: str = "mixed", *, speed_deg_s: float = 0.0, background: bool = False
) -> Tracks:
    """The person before a camera that stands or orbits: nothing but the lens is known of it, or fixed points too."""
    joints = truth(time_s, action)
    middle = np.broadcast_to(joints[:, 0].mean(axis=0), (len(joints), 3))
    rotation, position = orbit_camera(time_s, middle, 7.0, 1.6, speed_deg_s, bearing_deg)
    matrix = pinhole_matrix(*SIZE, 60.0)
    pixels = project(joints, rotation, position, matrix)
    pixels += np.random.default_rng(int(bearing_deg)).normal(0.0, 2.0, pixels.shape)
    stamps = np.round(np.arange(len(joints)) * 1e9 / FPS).astype(np.int64)
    tracks = Tracks(pixels, BODY_17.joints, stamps, SIZE, camera_matrix=matrix)
    if not background:
        return tracks
    path = PinholePath(position, rotation, float(matrix[0, 0]), SIZE)
    return replace(tracks, background=followed_points(path, joints, FPS, 0))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    time_s = np.arange(FRAMES) / FPS
    save_tracks(folder / "left.npz", seen_from(0.0, time_s))
    right = seen_from(100.0, time_s[:-40] + LATER_S)
    save_tracks(folder / "right.npz", replace(right, stamp_ns=right.stamp_ns + _CLOCK_NS))
    save_tracks(folder / "no_lens.npz", replace(right, camera_matrix=None))
    save_tracks(folder / "other.npz", seen_from(100.0, time_s, "squats"))
    return folder


def test_two_still_cameras_give_one_body_that_is_better_than_either(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = [str(recordings / name) for name in ("left.npz", "right.npz")]
    assert main(["reconstruct", *inputs, "--together", "--out", str(tmp_path / "both"), "--no-report"]) == 0
    said = capsys.readouterr().out
    assert "right.npz: its first image 0.8" in said
    assert "after that of left.npz" in said
    assert main(["reconstruct", inputs[0], "--out", str(tmp_path / "one"), "--no-report", "--quiet"]) == 0
    both, one = (load_motion(tmp_path / name) for name in ("both", "one"))
    joints = truth(np.arange(FRAMES) / FPS)
    error, alone = (pa_mpjpe(motion.joints3d[:, :15], joints[:, :15]).mean() for motion in (both, one))
    assert error < 0.8 * alone
    view = both.meta["together"]["views"][1]
    assert view["offset_s"] == pytest.approx(LATER_S, abs=0.01)
    assert view["median_px"] < 5.0
    # The second camera's file has the same motion on its own clock, and a camera that sees its own keypoints.
    right = load_motion(tmp_path / "both" / "camera_2.npz")
    assert right.stamp_ns[0] == pytest.approx(_CLOCK_NS, abs=1e9 / FPS)
    assert right.camera_position is not None
    there = np.flatnonzero(both.stamp_ns * 1e-9 >= view["offset_s"])[: len(right.stamp_ns)]
    np.testing.assert_array_equal(right.joints3d, both.joints3d[there])
    assert float(np.nanmedian(right.reprojection_px)) < 5.0


def test_recordings_are_corrected_one_by_one_and_solved_again_together(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, legs = tmp_path / "both", [BODY_17.index(name) for name in ("lknee", "lankle", "ltoe")]
    swapped, inputs = [BODY_17.index(other_side(BODY_17.joints[j], BODY_17.joints)) for j in legs], []
    for name in ("left", "right"):
        tracks = load_tracks(recordings / f"{name}.npz")
        wrong = tracks.keypoints.copy()
        if name == "right":  # for a second
            wrong[40:65, legs + swapped] = wrong[40:65, swapped + legs]
        save_tracks(tmp_path / f"{name}.npz", replace(tracks, keypoints=wrong))
        inputs.append(str(tmp_path / f"{name}.npz"))
    base = ["--together", "--out", str(out), "--no-report", "--quiet"]
    assert main(["reconstruct", *inputs, *base]) == 0
    before = load_motion(out)
    kept = [str(out / "tracks.npz"), str(out / "camera_2_tracks.npz")]
    assert main(["reconstruct", *kept, *base]) == 0  # from what it has kept
    np.testing.assert_array_equal(load_motion(out).joints3d, before.joints3d)
    said = {"sides": [{"from": 40 / FPS, "to": 64 / FPS, "limbs": "legs"}]}
    save_corrections(out / "camera_2_corrections.yaml", said)
    assert main(["reconstruct", *kept, *base, "--corrections", str(out)]) == 0
    after, second = load_motion(out), load_motion(out / "camera_2.npz")
    assert second.meta["corrections"] == said
    assert "corrections" not in after.meta
    joints = truth(np.arange(FRAMES) / FPS)
    begin = 40 + round(LATER_S * FPS)
    knees = np.s_[begin : begin + 25, [BODY_17.index("lknee"), BODY_17.index("rknee")]]
    errors = [aligned_error(motion.joints3d[:, :17], joints)[knees].mean() for motion in (before, after)]
    assert errors[1] < 0.7 * errors[0]
    # A file alone is the first recording's; a folder without one is refused, and so is a video of one of them.
    save_corrections(tmp_path / "first.yaml", said)
    assert main(["reconstruct", *kept, *base, "--corrections", str(tmp_path / "first.yaml")]) == 0
    assert load_motion(out).meta["corrections"] == said
    for words, expected in (
        (["--corrections", str(recordings)], "expected corrections.yaml beside its motions"),
        (["--video", str(recordings / "left.npz")], "expected one for each INPUT, 2, found 1"),
    ):
        assert main(["reconstruct", *kept, *base, *words]) == 2
        assert expected in capsys.readouterr().err


@pytest.mark.parametrize("background", [True, False])
def test_a_flying_camera_without_telemetry_makes_the_body_better_than_either_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], background: bool
) -> None:
    time_s = np.arange(FRAMES) / FPS
    left = seen_from(0.0, time_s, speed_deg_s=10.0, background=background)
    right = seen_from(100.0, time_s[:-40] + LATER_S, speed_deg_s=-20.0)
    save_tracks(tmp_path / "left.npz", left)
    save_tracks(tmp_path / "right.npz", replace(right, stamp_ns=right.stamp_ns + _CLOCK_NS))
    inputs = [str(tmp_path / name) for name in ("left.npz", "right.npz")]
    assert main(["reconstruct", *inputs, "--together", "--out", str(tmp_path / "both"), "--no-report"]) == 0
    said = capsys.readouterr().out
    assert "its camera moves as the body turns in its pictures" in said
    for name in ("left", "right"):
        one = ["reconstruct", str(tmp_path / f"{name}.npz"), "--out", str(tmp_path / name), "--no-report", "--quiet"]
        assert main(one) == 0
    both, one, other = (load_motion(tmp_path / name) for name in ("both", "left", "right"))
    joints = truth(time_s)
    error, alone = (pa_mpjpe(motion.joints3d[:, :15], joints[:, :15]).mean() for motion in (both, one))
    assert error < 0.8 * alone
    assert error < 0.8 * pa_mpjpe(other.joints3d[:, :15], truth(time_s[:-40] + LATER_S)[:, :15]).mean()
    assert both.meta["together"]["views"][1]["offset_s"] == pytest.approx(LATER_S, abs=0.02)
    # Without fixed points nothing tells how the first camera moves: there is no world, and the command says so.
    assert both.frame == ("world" if background else "camera")
    assert ("a path through a world is not known" in said) == (not background)


def test_a_recording_of_another_motion_is_refused_by_its_name(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = [str(recordings / name) for name in ("left.npz", "other.npz")]
    assert main(["reconstruct", *inputs, "--together", "--out", str(tmp_path / "no")]) == 2
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0
    assert "other.npz: expected the motion that left.npz shows" in error
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["left.npz", "right.npz"], "add --together"),
        (["left.npz", "--together"], "two INPUTs"),
        (["left.npz", "left.npz", "--together"], "same one twice"),
        (["left.npz", "right.npz", "--together", "--start", "1"], "--start"),
        (["left.npz", "right.npz", "--together", "--method", "paper"], "--method"),
        (["left.npz", "missing.npz", "--together"], "no such file"),
        (["left.npz", "no_lens.npz", "--together"], "no_lens.npz: expected a known lens"),
    ],
)
def test_what_does_not_fit_together_is_one_line(
    recordings: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, options: list[str], word: str
) -> None:
    monkeypatch.chdir(recordings)
    before = sorted(recordings.iterdir())
    assert main(["reconstruct", *options]) == 2
    error = capsys.readouterr().err.strip()
    assert word in error
    assert "\n" not in error
    assert sorted(recordings.iterdir()) == before
