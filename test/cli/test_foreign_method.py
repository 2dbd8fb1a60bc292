"""A method of another package, as `docs/api.md` shows it: its two files, found by their entry point."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from walking import make_walk

from drocap_ros.motion import load_motion
from drocap_ros.simulation.capture import simulate_capture
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import save_tracks


@pytest.fixture(scope="module")
def package(root, tmp_path_factory):
    """The page's package as pip lays it: the module, and the entry point beside it."""
    page = (root / "docs" / "api.md").read_text()
    folder = tmp_path_factory.mktemp("site")
    (source,) = re.findall(r"```python\n# flat_body\.py\n(.*?)```", page, re.DOTALL)
    (point,) = re.findall(r'\[project\.entry-points\."drocap_ros\.methods"\]\n(.*?)```', page, re.DOTALL)
    (folder / "flat_body.py").write_text(source)
    (folder / "broken_body.py").write_text("def run(data):\n    return data.keypoints.xy\n")
    point = point.replace('"', "")  # the file that pip writes has none
    others = "torn = broken_body:run\ngone = no_such_module:run\nba = flat_body:run\n"
    info = folder / "flat_body-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: flat-body\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[drocap_ros.methods]\n{point.replace(chr(34), '')}{others}")
    return folder


@pytest.fixture(scope="module")
def drocap(root, package):
    def run(*words, module="drocap_ros.cli"):
        path = os.pathsep.join([str(package), str(root), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, "-m", module, *map(str, words)]
        env = {**os.environ, "PYTHONPATH": path}
        return subprocess.run(command, capture_output=True, text=True, timeout=250, env=env)

    return run


@pytest.fixture(scope="module")
def tracks(tmp_path_factory):
    path = tmp_path_factory.mktemp("tracks") / "walk.npz"
    save_tracks(path, simulate_capture(2.0, 15.0, seed=1).tracks)
    return path


def test_reconstruct_runs_it(drocap, tracks, tmp_path):
    done = drocap("reconstruct", tracks, "--method", "flat", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    motion = load_motion(tmp_path / "out" / "motion.npz")
    assert motion.meta["method"] == "flat"
    assert motion.meta["stop_reason"] == "flat"
    # Flat bodies turn with the camera: the depth along its axis is that of the pelvis.
    depth = np.einsum("fj,fpj->fp", motion.camera_rotation[:, 2], motion.joints3d - motion.joints3d[:, :1])
    across = np.ptp(motion.joints3d[..., 2], axis=1)
    assert np.abs(depth).max() < 0.2 * across.min()
    assert "reprojection" in done.stdout


def test_batch_runs_it(drocap, tracks, tmp_path):
    done = drocap("batch", tracks, "--method", "flat", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (line,) = (tmp_path / "out" / "batch.jsonl").read_text().splitlines()
    motion = load_motion(tmp_path / "out" / json.loads(line)["folder"] / "motion.npz")
    assert motion.meta["method"] == "flat"


def test_a_study_has_its_row(drocap, tmp_path):
    mm = (1000 * make_walk(130).shape).astype(np.float32)
    np.savez(tmp_path / "walk.npz", X=mm, fps=24.0, joints=np.array(BODY_15.joints))
    done = drocap("rotation", tmp_path, "--methods", "flat", "initial", "--speeds", "25", "--quiet", module="lab")
    assert done.returncode == 0, done.stderr
    error_mm = {cells[1].strip(): float(cells[2]) for line in done.stdout.splitlines()
                if len(cells := line.split("|")) == 5 and re.fullmatch(r" \d+\.\d ", cells[2])}  # fmt: skip
    assert error_mm["flat"] > error_mm["paper: single-view initialization"] > 0


def test_the_method_of_that_name_stays_ours(drocap, tracks, tmp_path):
    done = drocap("reconstruct", tracks, "--out", tmp_path / "out", "--no-report")
    assert done.returncode == 0, done.stderr
    assert load_motion(tmp_path / "out" / "motion.npz").meta["stop_reason"] != "flat"


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("torn", "expected ImagePoses with joints_px (30, 17, 3), found ndarray"),
        ("gone", "of the package flat-body: expected the function no_such_module:run"),
        ("absent", "'flat'"),
    ],
)
def test_a_method_that_cannot_run_is_refused_in_a_line(drocap, tracks, tmp_path, method, said):
    done = drocap("reconstruct", tracks, "--method", method, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
