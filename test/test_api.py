"""``from drocap_ros import ...``: the examples of docs/api.md as printed, lazy imports, types."""

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_person import rendered_images

import drocap_ros
from drocap_ros import api
from drocap_ros.cli import main
from drocap_ros.errors import InputError
from drocap_ros.motion import load_motion
from drocap_ros.recording.video_telemetry import Telemetry
from drocap_ros.simulation.simulated_person import simulate_person
from drocap_ros.skeleton import BODY_15
from drocap_ros.tracks import load_tracks, save_tracks
from lab.simulation.capture import simulate_capture


def python(text, cwd, root):
    (cwd / "example.py").write_text(text)
    env = {**os.environ, "PYTHONPATH": str(root), "DROCAP_MODELS": "simulation"}
    done = subprocess.run([sys.executable, "example.py"], cwd=cwd, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """walk.mp4 of a rendered person, its true joints as MoCap, and tracks of another."""
    folder = tmp_path_factory.mktemp("api")
    images = rendered_images(8)
    writer = cv2.VideoWriter(str(folder / "walk.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (1280, 720))
    for image in images:
        writer.write(image)
    writer.release()
    joints = simulate_person(0.7 + np.arange(len(images)) / 30.0, "mixed", 0)
    np.savez(folder / "truth.npz", X=1000 * joints, fps=30.0, joints=np.array(BODY_15.joints))
    save_tracks(folder / "tracks.npz", simulate_capture(1.0, 15.0, seed=1).tracks)
    return folder


def test_examples_of_the_page_run_as_printed(folder, root):
    examples = re.findall(r"```python\n(.*?)```", (root / "docs" / "api.md").read_text(), re.DOTALL)
    assert len(examples) == 3  # the last is a file of a package: test_foreign_method.py
    said = python(examples[0], folder, root)
    assert said.startswith("(8, 17, 3) camera\n")
    assert 0 < float(said.split()[-2]) < 300
    assert (folder / "walk.bvh").read_text().startswith("HIERARCHY")
    assert python(examples[1], folder, root).endswith(" px\n")
    assert len(load_motion(folder / "motion.npz").joints3d) == 15


def test_functions_do_as_the_commands(folder, tmp_path):
    words = ["reconstruct", str(folder / "tracks.npz"), "--method", "initial", "--start", "0.2", "--quiet"]
    assert main([*words, "--out", str(tmp_path / "out"), "--no-report"]) == 0
    ours = load_motion(tmp_path / "out")
    for source in (folder / "tracks.npz", load_tracks(folder / "tracks.npz")):
        motion = drocap_ros.reconstruct(source, method="initial", start_s=0.2)
        for name in ("joints3d", "stamp_ns", "reprojection_px", "confidence"):
            np.testing.assert_array_equal(getattr(motion, name), getattr(ours, name))
    assert drocap_ros.compare(tmp_path / "out", motion).error_mm < 1e-6
    assert main(["export", str(tmp_path / "out"), "--to", "trc", "--quiet"]) == 0
    drocap_ros.export(tmp_path / "out", tmp_path / "motion.trc")
    assert (tmp_path / "motion.trc").read_bytes() == (tmp_path / "out" / "motion.trc").read_bytes()
    with pytest.raises(InputError, match="format: expected one of"):
        drocap_ros.export(motion, tmp_path / "walk.xyz")


def test_options_hold_for_tracks_as_for_their_file(folder):
    for source in (folder / "tracks.npz", load_tracks(folder / "tracks.npz")):
        assert drocap_ros.reconstruct(source, method="initial").frame == "world"
        assert drocap_ros.reconstruct(source, method="initial", telemetry="none").frame == "camera"
        with pytest.raises(InputError, match="--telemetry: expected a video"):
            drocap_ros.reconstruct(source, method="initial", telemetry="flight.tlog")
        with pytest.raises(InputError, match="--subject 2: expected images, found 2D tracks"):
            drocap_ros.reconstruct(source, method="initial", subject=2)


def test_import_of_the_package_loads_nothing_heavy(tmp_path, root):
    heavy = {"numpy", "cv2", "scipy", "onnxruntime", "drocap_ros.pipeline"}
    python(f"import sys, drocap_ros\nassert not {heavy!r} & set(sys.modules)\n", tmp_path, root)


def test_every_function_has_types(root):
    stub = (root / "drocap_ros" / "__init__.pyi").read_text()
    assert set(re.findall(r"import (\w+) as \1", stub)) == set(drocap_ros.__all__)
    with pytest.raises(AttributeError, match="no attribute 'reconstuct'"):
        drocap_ros.reconstuct  # noqa: B018


def test_the_log_beside_a_video_is_taken_as_a_path_as_words_and_with_its_options(tmp_path, monkeypatch):
    taken = []

    def reconstructed(*_, telemetry, **__):
        taken.append(telemetry)
        return None, None

    monkeypatch.setattr(api, "reconstruct_input", reconstructed)
    for given in (None, "flight.srt", tmp_path / "flight.srt", log := Telemetry(Path("a.srt"), 1.5)):
        drocap_ros.reconstruct("walk.mp4", telemetry=given)
    assert taken == [Telemetry(), Telemetry(Path("flight.srt")), Telemetry(tmp_path / "flight.srt"), log]
