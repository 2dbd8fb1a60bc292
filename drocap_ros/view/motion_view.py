"""A motion in the viewer."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.motion import Motion, upright_joints
from drocap_ros.report.pictures import Pictures
from drocap_ros.skeleton import JointSet
from drocap_ros.view.camera import LEVEL_CAMERA, nominal_camera_matrix, place_cameras
from drocap_ros.view.scene import Scene

PLOTS = ("reprojection_px", "confidence")


def draw_motion(scene: Scene, motion: Motion, pictures: Pictures | None = None) -> None:
    """Every frame of a motion at its stamp.

    A motion does not hold the camera's place: it is drawn from where the body would look as in its picture, with a
    nominal field of view (:func:`drocap_ros.view.camera.place_cameras`).
    """
    joints_of = JointSet("motion", motion.joints, motion.parents)
    joints = upright_joints(motion)
    rotation = motion.camera_rotation
    if motion.frame == "camera":
        rotation = np.broadcast_to(LEVEL_CAMERA, rotation.shape)
    size, keypoints, matrix = _picture_axes(motion, pictures)
    positions = place_cameras(joints, keypoints, rotation, matrix)
    jpegs = {} if pictures is None else dict(zip(pictures.frames, pictures.jpegs, strict=True))
    error = motion.reprojection_px
    scene.at(int(motion.stamp_ns[0]))
    scene.calibration(matrix, size)
    for i, stamp_ns in enumerate(motion.stamp_ns):
        scene.at(int(stamp_ns))
        scene.pose("refined", joints_of, joints[i])
        scene.keypoints(joints_of, keypoints[i])
        if np.isfinite(positions[i]).all():
            scene.camera(positions[i], rotation[i])
        if i in jpegs:
            scene.jpeg(jpegs[i])
        seen = np.isfinite(error[i])
        scene.plot("reprojection_px/mean", float(error[i][seen].mean()) if seen.any() else math.nan)
        scene.plot("confidence/mean", float(np.nan_to_num(motion.confidence[i]).mean()))
    known = positions[np.isfinite(positions).all(1)]
    if motion.frame == "world" and len(known) > 1:
        scene.at(int(motion.stamp_ns[0]))
        scene.camera_path(known)


def _picture_axes(motion: Motion, pictures: Pictures | None) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """Size px, keypoints (F, P, 2) px and camera matrix of the pictures that are shown: the image, or cut from it."""
    seen = np.isfinite(motion.keypoints).all(-1)
    corner = motion.keypoints[seen].max(0) if seen.any() else np.array([640.0, 480.0])
    width, height = (max(16, math.ceil(float(c))) for c in corner)
    if pictures is None:
        return (width, height), motion.keypoints, nominal_camera_matrix(width, height)
    x0, y0, x1, y1 = pictures.box
    zoom = np.array(pictures.size) / np.array([x1 - x0, y1 - y0])
    matrix = nominal_camera_matrix(max(width, x1), max(height, y1))
    matrix[:2, 2] -= (x0, y0)
    matrix[:2] *= zoom[:, None]
    return pictures.size, (motion.keypoints - np.array([x0, y0])) * zoom, matrix
