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
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import save_tracks
from lab.simulation.capture import simulate_capture

#: Methods that cannot run, and what is said of them.
REFUSED = {
    "torn": "expected ImagePoses with joints_px (30, 17, 3), found ndarray",
    "gone": "of the package flat-body: expected the function no_such_module:run",
    "absent": "'flat'",
}


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
def tracks(tmp_path_factory):
    path = tmp_path_factory.mktemp("tracks") / "walk.npz"
    save_tracks(path, simulate_capture(2.0, 15.0, seed=1).tracks)
    return path


#: Runs commands, those of the laboratory included, and prints the status and what each says.
RUN = """
import contextlib, io, json, sys
from drocap_ros.cli import main
from lab.commands import build_parser
for words in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(words, parser=build_parser() if words[0] == "rotation" else None)
    print(json.dumps([status, out.getvalue(), err.getvalue()]))
"""


@pytest.fixture(scope="module")
def done(root, package, tracks, tmp_path_factory):
    """Folder of the results, and status, output and errors of each command by its name; a process of its own."""
    folder = tmp_path_factory.mktemp("done")
    mocap = folder / "mocap"
    mocap.mkdir()
    mm = (1000 * make_walk(130).shape).astype(np.float32)
    np.savez(mocap / "walk.npz", X=mm, fps=24.0, joints=np.array(BODY_15.joints))
    commands = {
        "flat": ["reconstruct", tracks, "--method", "flat", "--out", folder / "flat"],
        "batch": ["batch", tracks, "--method", "flat", "--out", folder / "batch"],
        "study": ["rotation", mocap, "--methods", "flat", "initial", "--speeds", "25", "--quiet"],
        "ba": ["reconstruct", tracks, "--out", folder / "ba", "--no-report"],
        **{name: ["reconstruct", tracks, "--method", name, "--out", folder / name] for name in REFUSED},
    }
    words = json.dumps([[str(word) for word in command] for command in commands.values()])
    path = os.pathsep.join([str(package), str(root), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path}
    ran = subprocess.run([sys.executable, "-c", RUN, words], capture_output=True, text=True, timeout=280, env=env)
    assert ran.returncode == 0, ran.stderr
    return folder, dict(zip(commands, map(json.loads, ran.stdout.splitlines()), strict=True))


def test_reconstruct_runs_it(done):
    folder, ran = done
    status, said, errors = ran["flat"]
    assert status == 0, errors
    motion = load_motion(folder / "flat" / "motion.npz")
    assert motion.meta["method"] == "flat"
    assert motion.meta["stop_reason"] == "flat"
    # Flat bodies turn with the camera: the depth along its axis is that of the pelvis.
    depth = np.einsum("fj,fpj->fp", motion.camera_rotation[:, 2], motion.joints3d - motion.joints3d[:, :1])
    across = np.ptp(motion.joints3d[..., 2], axis=1)
    assert np.abs(depth).max() < 0.2 * across.min()
    assert "reprojection" in said


def test_batch_and_a_study_run_it(done):
    folder, ran = done
    assert (ran["batch"][0], ran["study"][0]) == (0, 0), ran
    (line,) = (folder / "batch" / "batch.jsonl").read_text().splitlines()
    motion = load_motion(folder / "batch" / json.loads(line)["folder"] / "motion.npz")
    assert motion.meta["method"] == "flat"
    error_mm = {cells[1].strip(): float(cells[2]) for line in ran["study"][1].splitlines()
                if len(cells := line.split("|")) == 5 and re.fullmatch(r" \d+\.\d ", cells[2])}  # fmt: skip
    assert error_mm["flat"] > error_mm["paper: single-view initialization"] > 0


def test_the_method_of_that_name_stays_ours(done):
    folder, ran = done
    assert ran["ba"][0] == 0, ran["ba"]
    assert load_motion(folder / "ba" / "motion.npz").meta["stop_reason"] != "flat"


@pytest.mark.parametrize("name", REFUSED)
def test_a_method_that_cannot_run_is_refused_in_a_line(done, name):
    status, _, errors = done[1][name]
    assert status == 2
    assert REFUSED[name] in errors
    assert errors.count("\n") == 1
