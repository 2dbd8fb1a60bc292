"""A motion in the viewer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.skeleton import JointSet
from drocap_ros.view.camera_placement import nominal_camera_matrix, place_cameras
from drocap_ros.view.rerun_scene import Scene

#: Images are shrunk to this: a minute of video then gives a file of about 150 MB.
_LONG_SIDE = 960


def draw_motion(
    scene: Scene,
    motion: Motion,
    images: Iterable[tuple[int, np.ndarray]] = (),
    progress: Callable[[str, float], None] = lambda _stage, _done: None,
) -> None:
    """Every frame of a motion at its stamp, and its images: frame and (H, W, 3) uint8 BGR.

    A camera whose position the motion does not hold is placed so that the body projects to its keypoints, with a
    nominal field of view (:func:`drocap_ros.view.camera_placement.place_cameras`).
    """
    size, zoom = _image_size(motion), 1.0
    for index, image in images:
        size = (image.shape[1], image.shape[0])
        zoom = min(1.0, _LONG_SIDE / max(size))
        scene.at(int(motion.stamp_ns[index]))
        scene.image(_shrunk(image, zoom))
        progress("images", (index + 1) / len(motion.stamp_ns))
    _draw_frames(scene, motion, motion.keypoints * zoom, (round(size[0] * zoom), round(size[1] * zoom)), progress)


def _draw_frames(
    scene: Scene, motion: Motion, keypoints: np.ndarray, size: tuple[int, int], progress: Callable[[str, float], None]
) -> None:
    joints_of = JointSet("motion", motion.joints, motion.parents)
    joints = upright_joints(motion)
    rotation = upright_camera_rotation(motion)
    positions, matrix = _cameras(motion, joints, keypoints, rotation, size)
    error = motion.reprojection_px
    scene.at(int(motion.stamp_ns[0]))
    scene.calibration(matrix, size)
    known = positions[np.isfinite(positions).all(1)]
    if motion.frame == "world" and len(known) > 1:
        scene.camera_path(known)
    for i, stamp_ns in enumerate(motion.stamp_ns):
        scene.at(int(stamp_ns))
        scene.pose(joints_of, joints[i])
        scene.keypoints(joints_of, keypoints[i])
        if np.isfinite(positions[i]).all():
            scene.camera(positions[i], rotation[i])
        seen = np.isfinite(error[i])
        scene.plot("reprojection_px/mean", float(error[i][seen].mean()) if seen.any() else math.nan)
        scene.plot("confidence/mean", float(np.nan_to_num(motion.confidence[i]).mean()))
        progress("frames", (i + 1) / len(motion.stamp_ns))


def _cameras(
    motion: Motion, joints: np.ndarray, keypoints: np.ndarray, rotation: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (F, 3) m and matrix (3, 3) px of the cameras.

    A motion holds no focal length: with its own positions that one which projects the body to its keypoints.
    """
    matrix = nominal_camera_matrix(*size)
    if motion.camera_position is None or not np.nan_to_num(joints[:, 0]).any():  # the body has no place
        return place_cameras(joints, keypoints, rotation, matrix), matrix
    seen = (joints - motion.camera_position[:, None]) @ np.swapaxes(rotation, 1, 2)
    rays = seen[..., :2] / np.where(seen[..., 2:] > 0.1, seen[..., 2:], np.nan)
    known = np.isfinite(rays + keypoints).all(axis=2, keepdims=True)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    # About their means: an error of the camera's rotation moves all joints of an image alike.
    rays, pixels = (
        np.where(known, v - np.where(known, v, 0.0).sum(1, keepdims=True) / count, 0.0) for v in (rays, keypoints)
    )
    if (focal := float((rays * pixels).sum() / max(np.square(rays).sum(), 1e-12))) > 1.0:
        matrix[[0, 1], [0, 1]] = focal
    return motion.camera_position, matrix


def _image_size(motion: Motion) -> tuple[int, int]:
    """Width and height px of the images; where the motion does not state them, those that hold all keypoints."""
    stated = motion.meta.get("images")
    size = stated.get("size") if isinstance(stated, dict) else None
    if isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size):
        return size[0], size[1]
    seen = motion.keypoints[np.isfinite(motion.keypoints).all(-1)]
    corner = seen.max(0) if len(seen) else np.array([640.0, 480.0])
    return max(16, math.ceil(float(corner[0]))), max(16, math.ceil(float(corner[1])))


def _shrunk(image: np.ndarray, zoom: float) -> np.ndarray:
    if zoom == 1.0:
        return image
    import cv2

    size = (round(image.shape[1] * zoom), round(image.shape[0] * zoom))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
