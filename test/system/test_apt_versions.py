"""A video is reconstructed with the NumPy, SciPy and OpenCV that Debian 12 and Ubuntu 24.04 install by apt."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from rendered_person import rendered_images

from drocap_ros.motion import load_motion

#: Of Ubuntu 24.04: python3-numpy 1.26.4, python3-scipy 1.11.4, python3-opencv 4.6.0.
VERSIONS = {"numpy": "1.26.4", "scipy": "1.11.4", "opencv-python-headless": "4.6.0.66"}
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """Folder with those versions; their wheels exist up to Python 3.12."""
    folder = tmp_path_factory.mktemp("apt")
    wanted = [f"{name}=={version}" for name, version in VERSIONS.items()]
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--only-binary", ":all:"]
    done = subprocess.run([*words, "--target", str(folder), *wanted], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"the registry has no wheels of {', '.join(wanted)} for this Python, or is out of reach")
    return folder


def run(libraries, *words):
    """Run drocap with these libraries before those of the environment."""
    env = {**os.environ, "PYTHONPATH": f"{libraries}{os.pathsep}{ROOT}", "DROCAP_MODELS": "simulation"}
    command = [sys.executable, "-m", "drocap_ros.cli", *map(str, words)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=240)


def test_a_video_becomes_a_motion_and_its_exports(libraries, tmp_path):
    clip = tmp_path / "walk.mp4"
    writer = cv2.VideoWriter(str(clip), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (1280, 720))
    for image in rendered_images(24):
        writer.write(image)
    writer.release()
    done = run(libraries, "reconstruct", clip, "--out", tmp_path / "out", "--quiet")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    motion = load_motion(tmp_path / "out")
    assert motion.meta["versions"]["numpy"] == VERSIONS["numpy"]
    assert len(motion.joints3d) == 24
    for kind in ("bvh", "c3d", "trc", "glb"):
        done = run(libraries, "export", tmp_path / "out", "--to", kind, "--out", tmp_path / f"walk.{kind}")
        assert done.returncode == 0, done.stderr
    assert run(libraries, "track", tmp_path / "missing.mp4").returncode == 2
