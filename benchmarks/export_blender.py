"""A motion in Blender: `PYTHONPATH=. python benchmarks/export_blender.py MOTION --out PNG`.

Exports the motion to BVH and glTF, imports both by Blender's own importers, prints how far their joints are from the
motion's, and renders a still of the glTF skeleton.  Without a screen and without a GPU.  Needs Python 3.11 with bpy 5.0
(Blender as a module), scipy, pyyaml and onnxruntime: bpy accepts no numpy 2, which the project's own environment has.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from drocap_ros import export, load_motion
from drocap_ros.motion import Motion, upright_joints

CENTIMETRES = 0.01
SAMPLES, WIDTH, HEIGHT = 24, 1280, 720
FRAMES = 12


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("motion", type=Path, metavar="MOTION")
    parser.add_argument("--out", type=Path, required=True, metavar="PNG")
    parser.add_argument("--at", type=float, default=0.5, metavar="SHARE", help="of the clip, for the still")
    args = parser.parse_args()
    motion = load_motion(args.motion)
    with tempfile.TemporaryDirectory(prefix="drocap_blender_") as name:
        for format_, load in (("bvh", load_bvh), ("glb", load_glb)):
            file = Path(name) / f"motion.{format_}"
            export(motion, file, format_)
            clear()
            armature = load(file)
            print(f"{format_}: {len(armature.pose.bones)} bones, {distances(armature, motion)}")
        still(armature, args.at, args.out)
    print(f"written: {args.out}")
    return 0


def clear() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)


def load_bvh(file: Path) -> bpy.types.Object:
    bpy.ops.import_anim.bvh(
        filepath=str(file), global_scale=CENTIMETRES, update_scene_fps=True, update_scene_duration=True
    )
    return next(o for o in bpy.data.objects if o.type == "ARMATURE")


def load_glb(file: Path) -> bpy.types.Object:
    bpy.ops.import_scene.gltf(filepath=str(file))
    armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
    first, last = armature.animation_data.action.frame_range
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = int(first), int(last)
    return armature


def distances(armature: bpy.types.Object, motion: Motion) -> str:
    """Joints of the imported armature against the motion's, both from their mean, over frames of the whole clip."""
    scene = bpy.context.scene
    seconds = (motion.stamp_ns - motion.stamp_ns[0]) / 1e9
    rate = scene.render.fps / scene.render.fps_base
    truth = upright_joints(motion)
    common = [i for i, name in enumerate(motion.joints) if name in armature.pose.bones]
    found = []
    for i in np.linspace(0, len(seconds) - 1, FRAMES).astype(int):
        frame = scene.frame_start + seconds[i] * rate
        scene.frame_set(int(frame), subframe=float(frame % 1.0))
        heads = np.array([place(armature, motion.joints[k]) for k in common])
        off = heads - truth[i, common]
        found.append(1000.0 * np.linalg.norm(off - off.mean(axis=0), axis=1))
    return f"{len(common)} joints {np.mean(found):.1f} mm from the motion's on average, at most {np.max(found):.1f} mm"


def place(armature: bpy.types.Object, bone: str) -> Vector:
    return armature.matrix_world @ armature.pose.bones[bone].head


def still(armature: bpy.types.Object, at: float, out: Path) -> None:
    """Cycles on the processor: the person on a grey floor, from the front, the left and above."""
    scene = bpy.context.scene
    scene.frame_set(int(scene.frame_start + at * (scene.frame_end - scene.frame_start)))
    centre = place(armature, "pelvis")
    left = place(armature, "lhip") - place(armature, "rhip")
    left = Vector((left.x, left.y, 0.0)).normalized()
    front = Vector((left.y, -left.x, 0.0))
    bpy.ops.mesh.primitive_plane_add(size=20.0, location=(centre.x, centre.y, 0.0))
    light = -(2.0 * front - left + Vector((0.0, 0.0, 2.0)))
    bpy.ops.object.light_add(type="SUN", rotation=light.to_track_quat("-Z", "Y").to_euler())
    bpy.context.object.data.energy = 3.0
    scene.world = bpy.data.worlds.new("sky")
    scene.world.color = (0.4, 0.45, 0.5)
    eye = centre + 4.2 * front + 2.4 * left + Vector((0.0, 0.0, 1.0))
    bpy.ops.object.camera_add(location=eye, rotation=(centre - eye).to_track_quat("-Z", "Y").to_euler())
    scene.camera = bpy.context.object
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", SAMPLES
    scene.render.resolution_x, scene.render.resolution_y, scene.render.filepath = WIDTH, HEIGHT, str(out.resolve())
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    sys.exit(main())
