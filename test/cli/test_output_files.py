"""Where the commands write, and what they never replace."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refused

from drocap_ros.cli import main
from drocap_ros.cli.atomic_output import default_folder, output_folder
from drocap_ros.motion import load_motion, save_motion
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture

OWN_INPUT = "found the command's own input"


@pytest.fixture
def folder(walker, tmp_path):
    save_motion(tmp_path / "motion.npz", walker)
    return tmp_path


@pytest.mark.parametrize("words", ["export --to csv --out", "export --to bvh --out", "report --out", "view --save"])
def test_a_motion_is_not_replaced_by_what_is_made_of_it(folder, capsys, words):
    if words.startswith("view"):
        pytest.importorskip("rerun")
    command, *options = words.split()
    before = (folder / "motion.npz").read_bytes()
    (folder / "link.npz").symlink_to("motion.npz")
    for name in ("motion.npz", "link.npz"):
        refused([command, folder, *options, folder / name], folder, capsys, f"{options[-1]} {folder / name}: expected")
    assert (folder / "motion.npz").read_bytes() == before


def test_a_video_is_not_replaced_by_its_overlay(tmp_path, capsys):
    (tmp_path / "overlay.mp4").write_bytes(b"a video")
    words = ["track", tmp_path / "overlay.mp4", "--out", tmp_path, "--models", "simulation"]
    refused([*words, "--overlay"], tmp_path, capsys, OWN_INPUT)


def test_reconstruct_beside_its_tracks_leaves_them_as_they_are(tmp_path, capsys):
    save_tracks(tmp_path / "tracks.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    before = (tmp_path / "tracks.npz").stat()
    words = ["reconstruct", tmp_path / "tracks.npz", "--out", tmp_path, "--method", "initial", "--no-report"]
    refused([*words, "--end", "0.5"], tmp_path, capsys, OWN_INPUT)
    assert main([str(word) for word in words]) == 0
    assert capsys.readouterr().out.endswith(f"written: {tmp_path}/motion.npz\n")
    assert len(load_motion(tmp_path).stamp_ns) == 15
    after = (tmp_path / "tracks.npz").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_no_report_of_an_older_run_stays_beside_a_new_motion(tmp_path):
    save_tracks(tmp_path / "a.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    (tmp_path / "out").mkdir()
    for name in ("report.html", "walk.bvh"):
        (tmp_path / "out" / name).write_text("old")
    words = ["reconstruct", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out"), "--method", "initial", "--quiet"]
    assert main([*words, "--no-report"]) == 0
    found = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert found == ["motion.npz", "tracks.npz", "walk.bvh"]


def test_default_folder_has_the_whole_name_of_the_input(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_tracks("walk.take1.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    assert main(["reconstruct", "walk.take1.npz", "--method", "initial", "--no-report", "--quiet"]) == 0
    assert Path("walk.take1_motion/motion.npz").is_file()
    Path("flight.2").mkdir()
    for name, expected in (
        ("session.mcap", "session_tracks"),
        ("flight.2", "flight.2_tracks"),
        (".hidden.mp4", "hidden_tracks"),
        (".", "drocap_tracks"),
    ):
        assert default_folder(Path(name), "tracks") == Path(expected)


def test_a_link_stays_and_its_file_is_written(folder):
    (folder / "link.csv").symlink_to("real.csv")
    for _ in range(2):
        assert main(["export", str(folder), "--to", "csv", "--out", str(folder / "link.csv")]) == 0
        assert (folder / "link.csv").is_symlink()
        assert (folder / "real.csv").read_text().startswith("time_s")
        (folder / "real.csv").write_text("old")


def test_a_pipe_is_no_output_file(folder, capsys):
    os.mkfifo(folder / "pipe.csv")
    refused(["export", folder, "--to", "csv", "--out", folder / "pipe.csv"], folder, capsys, "found a pipe or device")
    assert (folder / "pipe.csv").is_fifo()


def test_a_name_that_the_system_refuses_is_named(folder, capsys):
    for name in ("a" * 300, "/proc/a"):
        out = folder / f"{name}.csv"
        refused(["export", folder, "--to", "csv", "--out", out], folder, capsys, f"--out {out}: cannot be written")
        words = ["track", "a.mp4", "--out", out, "--list"]
        refused(words, folder, capsys, "--out" if name.startswith("a") else "a.mp4")


def test_a_full_disk_is_one_line_and_leaves_nothing(folder):
    before = sorted(folder.iterdir())
    # Without bytecode, which the limit would cut off in the environment.
    command = [sys.executable, "-B", "-m", "drocap_ros.cli", "export", str(folder), "--to", "csv"]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=300,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),  # the nearest to a full disk
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"drocap: --out {folder / 'motion.csv'}: expected space, found: ")
    assert done.stderr.count("\n") == 1
    assert sorted(folder.iterdir()) == before


def test_work_for_an_existing_folder_happens_inside(tmp_path):
    """Beside it may be another file system: files cannot be moved from there."""
    with output_folder(tmp_path) as work:
        assert work.parent == tmp_path
        (work / "a.txt").write_text("a")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
