"""USD's camera, and FBX by Blender."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drocap_ros.cli import main
from drocap_ros.export import export
from drocap_ros.export.usd import lens_of
from drocap_ros.motion import save_motion
from lab.simulation.capture import simulate_capture

ROOT = Path(__file__).parents[2]
_BACK = """
import sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.fbx(filepath=sys.argv[-1])
(rig,) = (thing for thing in bpy.data.objects if thing.type == "ARMATURE")
places = []
for frame in (2, 25):  # the file begins with frame 1, and the importer adds one
    bpy.context.scene.frame_set(frame)
    places += [rig.matrix_world @ rig.pose.bones[name].head for name in ("Hips", "LeftHand")]
print("rate", bpy.context.scene.render.fps, *(round(v, 4) for place in places for v in place))
"""


@pytest.fixture(scope="module")
def filmed(walker):
    """The walker in the world before a camera that moves, with keypoints of its lens."""
    capture = simulate_capture(2.0, 24.0, seed=1)
    matrix = capture.tracks.camera_matrix
    return dataclasses.replace(
        walker,
        joints3d=capture.joints3d_world,
        frame="world",
        stamp_ns=capture.tracks.stamp_ns,
        camera_rotation=capture.camera_rotation,
        camera_position=capture.camera_position,
        keypoints=capture.keypoints_exact,
    ), (float(matrix[0, 0]), *(2.0 * matrix[:2, 2]))


def test_lens_is_that_of_the_keypoints(filmed):
    motion, lens = filmed
    assert lens_of(motion) == pytest.approx(lens, rel=1e-6)


def test_camera_of_the_stage_sees_the_joints_where_the_keypoints_are(filmed, tmp_path):
    from export_readers import read_usd
    from pxr import Usd, UsdGeom

    motion, (_, width, height) = filmed
    export(motion, tmp_path / "motion.usd")
    stage = Usd.Stage.Open(str(tmp_path / "motion.usd"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/Motion/Camera"))
    back = read_usd(tmp_path / "motion.usd")
    places = back.positions[:, [back.joints.index(name) for name in motion.joints]]
    for frame in (0, 20, 47):
        view = camera.GetCamera(frame).frustum
        matrix = np.array(view.ComputeViewMatrix() * view.ComputeProjectionMatrix())
        x, y, z = np.moveaxis(places[frame], -1, 0)
        clip = np.stack([x, z, -y, np.ones(len(x))], axis=-1) @ matrix
        pixel = (clip[:, :2] / clip[:, 3:] * [0.5, -0.5] + 0.5) * [width, height]
        assert np.linalg.norm(pixel - motion.keypoints[frame], axis=1).max() < 2.0


def test_stage_without_the_package_is_one_line(filmed, tmp_path, monkeypatch, capsys):
    save_motion(tmp_path / "motion.npz", filmed[0])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    for form, words in (("usd", "drocap_ros[usd]"), ("fbx", "neither the program `blender` nor the package bpy")):
        assert main(["export", str(tmp_path / "motion.npz"), "--to", form]) == 2
        error = capsys.readouterr().err.strip()
        assert words in error
        assert "\n" not in error
        assert not (tmp_path / f"motion.{form}").exists()


def test_blender_reads_its_own_file(filmed, tmp_path):
    if importlib.util.find_spec("bpy") is None and shutil.which("blender") is None:
        pytest.skip("neither blender nor the package bpy is installed")
    motion, path = filmed[0], tmp_path / "motion.fbx"
    export(motion, path, names="lafan1")
    command = [sys.executable, "-c", _BACK]
    if importlib.util.find_spec("bpy") is None:
        command = ["blender", "--background", "--python-expr", _BACK, "--"]
    said = subprocess.run([*command, str(path)], capture_output=True, text=True, check=True).stdout
    words = next(line for line in said.splitlines() if line.startswith("rate")).split()
    assert float(words[1]) == 24
    places = np.array(words[2:], float).reshape(2, 2, 3)
    hips = motion.joints3d[[0, 23]][:, [motion.joints.index(name) for name in ("pelvis", "lwrist")]]
    off = places - hips
    assert np.linalg.norm(off - off.mean(axis=(0, 1)), axis=-1).max() < 0.02


def test_blender_opens_the_tutorial_s_file_without_settings(filmed, tmp_path):
    if importlib.util.find_spec("bpy") is None and shutil.which("blender") is None:
        pytest.skip("neither blender nor the package bpy is installed")
    page = (ROOT / "docs" / "tutorial.md").read_text()
    words = re.search(r"drocap (export walk .*)", page)[1].replace("walk.glb", str(tmp_path / "walk.glb")).split()
    save_motion(tmp_path / "motion.npz", filmed[0])
    assert main([str(tmp_path) if word == "walk" else word for word in words]) == 0
    script = """
import sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=sys.argv[-1])
(rig,) = (thing for thing in bpy.data.objects if thing.type == "ARMATURE")
heights = [(rig.matrix_world @ bone.head)[2] for bone in rig.pose.bones]
print("found", min(heights), max(heights), "Hips" in rig.pose.bones)
"""
    command = [sys.executable, "-c", script]
    if importlib.util.find_spec("bpy") is None:
        command = ["blender", "--background", "--python-expr", script, "--"]
    done = subprocess.run([*command, str(tmp_path / "walk.glb")], capture_output=True, text=True, check=True)
    low, high, named = next(line for line in done.stdout.splitlines() if line.startswith("found")).split()[1:]
    assert float(low) < 0.15
    assert 1.4 < float(high) < 2.0
    assert named == "True"
