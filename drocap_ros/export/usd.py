"""A motion as a stage of USD (UsdSkel, metres, y up), and as FBX by Blender's own exporter.

The person is a skeleton with constant bones and a mesh of one octahedron a bone.  The camera that saw it is beside it:
its place and attitude are those of the motion, its lens is that at which the motion's joints meet their keypoints.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.errors import InputError, first_line
from drocap_ros.export.animation import continuous, octahedra, write_bvh
from drocap_ros.export.rig import Rig, rig_of
from drocap_ros.export.take import Take, y_up
from drocap_ros.motion import Motion, upright_camera_rotation

#: z up -> y up: (x, y, z) becomes (x, z, -y).
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: Width of a full-frame sensor in tenths of a metre, the unit of lenses in a stage of metres.
_SENSOR = 0.36
#: The last two arguments are the BVH and the FBX file.
_BLENDER = """
import sys
import bpy
bvh, fbx = sys.argv[-2:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_anim.bvh(filepath=bvh, global_scale=0.01, update_scene_fps=True)
scene = bpy.context.scene
scene.frame_start, scene.frame_end = (round(frame) for frame in bpy.data.actions[0].frame_range)
bpy.ops.export_scene.fbx(filepath=fbx, object_types={"ARMATURE"}, add_leaf_bones=False, bake_anim_simplify_factor=0.0,
                         bake_anim_use_nla_strips=False, bake_anim_use_all_actions=False)
"""


def write_usd(path: Path, take: Take, *, names: str = "h36m", rest: str = "t", motion: Motion) -> tuple[str, ...]:
    """Write a stage of the z-up take of a motion; returns notes on changes.

    names, rest : as of :func:`~drocap_ros.export.rig.rig_of`
    """
    if importlib.util.find_spec("pxr") is None:
        install = f"{sys.executable} -m pip install 'drocap_ros[usd]'"
        raise InputError(f"usd: expected the package usd-core, found none; run {install}")
    from pxr import Usd, UsdGeom

    turned = y_up(take)
    rig, notes = rig_of(turned, names=names, rest=rest)
    times = np.round(take.times_s * take.rate_hz, 6)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(take.rate_hz)
    stage.SetFramesPerSecond(take.rate_hz)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(times[-1]))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Motion").GetPrim())
    _person(stage, rig, times)
    lift = float(np.nanmedian(rig.root[:, 1] - turned.positions[:, take.joints.index("pelvis"), 1]))
    if motion.camera_position is not None and len(motion.camera_position) == len(times):
        _camera(stage, motion, times, lift)
    else:
        notes = (*notes, "without the camera: its place is not known")
    stage.GetRootLayer().Save()
    return notes


def _person(stage: Any, rig: Rig, times: np.ndarray) -> None:  # pxr has no types
    """Skeleton, its animation and the mesh that follows it."""
    from pxr import Gf, Tf, UsdGeom, UsdSkel, Vt

    paths: list[str] = []
    for name, parent in zip(rig.names, rig.parents, strict=True):
        paths.append((f"{paths[parent]}/" if parent >= 0 else "") + Tf.MakeValidIdentifier(name))
    offsets = rig.rest - np.where(np.array(rig.parents)[:, None] >= 0, rig.rest[list(rig.parents)], 0.0)
    places = [[Gf.Matrix4d().SetTranslate(Gf.Vec3d(*map(float, p))) for p in points] for points in (rig.rest, offsets)]

    root = UsdSkel.Root.Define(stage, "/Motion/Person")
    skeleton = UsdSkel.Skeleton.Define(stage, "/Motion/Person/Skeleton")
    skeleton.CreateJointsAttr(paths)
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray(places[0]))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray(places[1]))
    animation = UsdSkel.Animation.Define(stage, "/Motion/Person/Skeleton/Animation")
    animation.CreateJointsAttr(paths)
    animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1.0)] * len(paths)))
    moved, turns = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    local = np.stack([continuous(rig.local(joint).as_quat()) for joint in range(len(paths))], axis=1)
    for frame, time in enumerate(times.tolist()):
        offsets[0] = rig.root[frame]
        moved.Set(Vt.Vec3fArray.FromNumpy(offsets.astype(np.float32)), time)
        turns.Set(Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in local[frame].tolist()]), time)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])

    corners, faces, owner = octahedra(rig)
    mesh = UsdGeom.Mesh.Define(stage, "/Motion/Person/Bones")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([3] * len(faces))
    mesh.CreateFaceVertexIndicesAttr(faces.reshape(-1).tolist())
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set(owner.tolist())
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * len(owner))
    UsdSkel.BindingAPI.Apply(root.GetPrim())


def _camera(stage: Any, motion: Motion, times: np.ndarray, lift: float) -> None:
    """The camera of a motion, ``lift`` m higher, as the person is; it looks along its -z, and its y is up."""
    from pxr import Gf, UsdGeom

    camera = UsdGeom.Camera.Define(stage, "/Motion/Camera")
    focal, width, height = lens_of(motion)
    camera.CreateHorizontalApertureAttr(_SENSOR)
    camera.CreateVerticalApertureAttr(_SENSOR * height / width)
    camera.CreateFocalLengthAttr(_SENSOR * focal / width)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.05, 1000.0))
    assert motion.camera_position is not None
    pose = UsdGeom.Xformable(camera).AddTransformOp()
    axes = upright_camera_rotation(motion) @ _Y_UP.T * np.array([[1.0], [-1.0], [-1.0]])
    places = motion.camera_position @ _Y_UP.T + [0.0, lift, 0.0]
    for time, rows, place in zip(times.tolist(), axes, places, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = rows, place
        pose.Set(Gf.Matrix4d(matrix.tolist()), time)


def lens_of(motion: Motion) -> tuple[float, float, float]:
    """Focal length, width and height (px) of the pictures in which the motion's joints meet their keypoints.

    The middle of the picture is the lens' axis.
    """
    position = np.zeros((len(motion.stamp_ns), 3)) if motion.camera_position is None else motion.camera_position
    seen = (motion.joints3d - position[:, None]) @ np.swapaxes(motion.camera_rotation, 1, 2)
    tangent, pixel = seen[..., :2] / np.maximum(seen[..., 2:], 1e-3), motion.keypoints
    both = np.isfinite(tangent).all(axis=-1) & np.isfinite(pixel).all(axis=-1)
    tangent, pixel = tangent[both], pixel[both]
    weight = np.ones(len(tangent))
    focal, middle = 1000.0, np.array([640.0, 360.0])
    for _ in range(10):  # a robust fit of pixel = focal * tangent + middle
        means = [np.average(values, axis=0, weights=weight) for values in (tangent, pixel)]
        about = tangent - means[0]
        focal = float((weight[:, None] * about * (pixel - means[1])).sum() / (weight[:, None] * about**2).sum())
        middle = means[1] - focal * means[0]
        off = np.linalg.norm(focal * tangent + middle - pixel, axis=1)
        weight = 1.0 / (1.0 + np.square(off / max(float(np.median(off)), 1e-6)))
    return focal, 2.0 * float(middle[0]), 2.0 * float(middle[1])


def write_fbx(path: Path, take: Take, *, names: str = "h36m", rest: str = "t") -> tuple[str, ...]:
    """Write FBX by Blender: the package ``bpy`` of this Python, or the program ``blender``; parameters as above."""
    if importlib.util.find_spec("bpy") is not None:
        command = [sys.executable, "-c", _BLENDER]
    elif (blender := shutil.which("blender")) is not None:
        command = [blender, "--background", "--python-exit-code", "1", "--python-expr", _BLENDER, "--"]
    else:
        raise InputError(
            "fbx: expected Blender, which writes FBX, found neither the program `blender` nor the package bpy; install"
            f" Blender, or run {sys.executable} -m pip install bpy; --to usd and --to glb need neither"
        )
    bvh = path.with_name("motion.bvh")
    notes = write_bvh(bvh, take, names=names, rest=rest)
    done = subprocess.run([*command, str(bvh), str(path)], capture_output=True, text=True, check=False)
    if done.returncode or not path.is_file():
        lines = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()
        raise InputError(f"fbx: expected a file from Blender, found none: {first_line(ValueError(lines[-1]))}")
    return notes
