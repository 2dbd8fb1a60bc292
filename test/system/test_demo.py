"""``drocap demo``: the whole capture flight, at small scale, as `make demo` runs it."""

import re
from pathlib import Path

import numpy as np

from drocap_ros.cli import main
from drocap_ros.motion import load_motion
from drocap_ros.recording.session_reader import session_info


def test_the_demo_ends_with_a_motion_near_the_truth(tmp_path, capsys):
    out = tmp_path / "demo"
    assert main(["demo", "--seconds", "6", "--seed", "1", "--out", str(out), "--quiet"]) == 0
    printed = capsys.readouterr().out
    error = float(re.search(r"truth: ([\d.]+) mm", printed)[1])
    # A person who holds every joint right but the depth of one arm is 60 mm off; depth = 0 would give 125.
    assert error < 100
    motion = load_motion(out / "motion.npz")
    assert motion.frame == "world"
    assert len(motion.joints3d) == 180
    assert np.isfinite(motion.joints3d).all()
    with np.load(out / "truth.npz") as truth:
        assert truth["joints3d"].shape == motion.joints3d.shape
        # In the world frame the person stands where the simulated one stood, to what an assumed stature allows.
        off = np.linalg.norm(motion.joints3d[:, 0] - truth["joints3d"][:, 0], axis=1)
    assert np.median(off) < 1.0
    info = session_info(out / "session")
    counts = {topic.name: topic.count for topic in info.topics}
    assert counts["/drocap/pose2d"] == 180
    assert counts["/drocap/vehicle/state"] > 200
    assert counts["/tf"] > 200
    assert {path.name for path in Path(out).iterdir()} == {
        "motion.npz",
        "truth.npz",
        "preview.png",
        "report.html",
        "session",
    }


def test_a_flight_without_length_is_refused(tmp_path, capsys):
    assert main(["demo", "--seconds", "-1", "--out", str(tmp_path / "demo")]) == 2
    assert "seconds: expected" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()
