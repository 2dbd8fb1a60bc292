"""The paper's tables from a folder of recordings with truth, through the command line."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from drocap_ros import export
from drocap_ros.cli import main
from drocap_ros.motion import load_motion, save_motion
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture


@pytest.fixture
def recordings(tmp_path, walker):
    """One recording in a folder of its own with a C3D as truth, one file beside its truth."""
    tracks = simulate_capture(2.0, 24.0, seed=3).tracks  # the walker's
    (tmp_path / "walk").mkdir()
    save_tracks(tmp_path / "walk" / "tracks.npz", tracks)
    export(walker, tmp_path / "walk" / "truth.c3d")
    save_tracks(tmp_path / "box.npz", tracks)
    save_motion(tmp_path / "box_truth.npz", walker)
    return tmp_path


def test_tables_hold_every_method_recording_and_mean(recordings, capsys):
    words = ["evaluate", "table", str(recordings), "--methods", "initial", "ba", "--quiet"]
    assert main([*words, "--out", str(recordings / "out")]) == 0
    printed = capsys.readouterr().out
    head, _, *lines = printed.split("Reconstruction error in mm.\n\n")[1].splitlines()[:4]
    assert head == "| method | walk | box | mean |"
    with (recordings / "out" / "table.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(r["sequence"], r["method"]) for r in rows] == [(n, m) for n in ("walk", "box") for m in ("initial", "ba")]
    for method, line in zip(("initial", "ba"), lines, strict=True):
        cells = [float(cell) for cell in line.split("|")[2:5]]
        errors = [float(r["error_mm"]) for r in rows if r["method"] == method]
        assert np.allclose(cells, [*errors, np.mean(errors)], atol=0.06)
        assert errors[0] == pytest.approx(errors[1], abs=0.05)  # C3D holds float32 millimetres
    assert "| method | wrist | elbow | shoulder | hip | knee | ankle | toe |" in printed
    assert main(["reconstruct", str(recordings / "box.npz"), "--no-report", "--out", str(recordings / "m")]) == 0
    save_motion(recordings / "m.npz", load_motion(recordings / "m"))
    assert main(["evaluate", "compare", str(recordings / "m.npz"), str(recordings / "box_truth.npz")]) == 0
    assert f"| {float(rows[3]['error_mm']):.1f} |" in capsys.readouterr().out


def test_what_cannot_be_used_is_left_out_in_a_line_or_refused(recordings, capsys, caplog):
    (recordings / "box_truth.npz").write_bytes(b"no archive")
    words = ["evaluate", "table", str(recordings), "--methods", "initial", "--quiet"]
    assert main(words) == 0
    assert "| method | walk | mean |" in capsys.readouterr().out
    assert caplog.text.count("box: left out:") == 1
    (recordings / "walk" / "tracks.npz").rename(recordings / "walk" / "a.npz")
    (recordings / "walk" / "b.npz").write_bytes(b"")
    assert main(words) == 2
    assert "expected one recording beside truth.c3d, found a.npz, b.npz" in capsys.readouterr().err
    (recordings / "walk" / "truth.c3d").unlink()
    (recordings / "box_truth.npz").unlink()
    assert main(words) == 2
    assert "name the files so" in capsys.readouterr().err
