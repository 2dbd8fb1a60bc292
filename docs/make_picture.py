"""Write docs/capture.jpg, the picture of README: ``python docs/make_picture.py``.

A simulated drone orbits a simulated person.  The rendered images go through the pose estimator with the networks for
simulation, their keypoints through the default method.  Left: one image with its 2D keypoints.  Right: the 3D motion
and the camera's path.  No ROS; the same picture on every run.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from drocap_ros.motion import Motion  # noqa: E402
from drocap_ros.perception.estimator import PoseEstimator  # noqa: E402
from drocap_ros.perception.load_models import models_folder  # noqa: E402
from drocap_ros.perception.track_video import tracks_from_observations  # noqa: E402
from drocap_ros.perception.tracking.pose_estimator_config import PoseEstimatorConfig  # noqa: E402
from drocap_ros.reconstruction.reconstruct import reconstruct  # noqa: E402
from drocap_ros.simulation.pinhole import pinhole_matrix  # noqa: E402
from drocap_ros.simulation.render.renderer import Renderer  # noqa: E402
from drocap_ros.simulation.simulated_person import simulate_person  # noqa: E402
from lab.simulation.orbit import orbit_camera  # noqa: E402

SEED, SECONDS, FPS, ACTION = 11, 8.0, 15.0, "walk"
WIDTH, HEIGHT, FIELD_DEG = 1280, 720, 60.0
RADIUS_M, CAMERA_HEIGHT_M, SPEED_DEG_S = 4.0, 2.4, 30.0
#: Frame of the left image, and frames of the earlier poses on the right.
SHOWN, EARLIER = 101, (5, 21, 37, 53, 69, 85)
#: Sizes of the left and the right panel.
LEFT_PX, RIGHT_PX, TALL_PX = 440, 840, 560
#: View of the right panel: turned from the side of the walked path, from above; half the ground's width.
TURN_DEG, ELEVATION_DEG, GROUND_M = -8.0, 22.0, 12.0
LEFT, RIGHT, MIDDLE = "#2e86de", "#e4572e", "#3fb56f"


def capture() -> tuple[np.ndarray, Motion, np.ndarray]:
    """The shown image (H, W, 3) BGR, the reconstructed motion, and the camera's path (F, 3) m."""
    t = np.arange(round(SECONDS * FPS)) / FPS
    joints = simulate_person(t, ACTION, SEED)
    aim = joints[:, 0] * (1, 1, 0) + (0, 0, 0.9)
    rotation, position = orbit_camera(t, aim, RADIUS_M, CAMERA_HEIGHT_M, SPEED_DEG_S, start_deg=10.0)
    matrix = pinhole_matrix(WIDTH, HEIGHT, FIELD_DEG)
    renderer = Renderer(matrix, WIDTH, HEIGHT, SEED)
    estimator = PoseEstimator(models_folder("simulation"), PoseEstimatorConfig())
    observations, shown = [], None
    for i, seconds in enumerate(t):
        image = renderer.render(joints[i], rotation[i], position[i])
        observations.append(estimator.process(image, round(seconds * 1e9)))
        shown = image if i == SHOWN else shown
    tracks = replace(
        tracks_from_observations(observations),
        camera_rotation=rotation, camera_position=position, camera_matrix=matrix,
    )  # fmt: skip
    assert shown is not None
    return shown, reconstruct(tracks), position


def colour_of(joint: str) -> str:
    """Colour of the bone that ends at a joint, by the side of the body."""
    return MIDDLE if joint in ("pelvis", "neck", "head") else LEFT if joint.startswith("l") else RIGHT


def overlay(image: np.ndarray, motion: Motion) -> np.ndarray:
    """(TALL_PX, LEFT_PX, 3) RGB: the image around the subject with bones and keypoints."""
    points = motion.keypoints[SHOWN]
    middle = np.nanmean(points, axis=0)
    scale = TALL_PX / min(1.35 * float(np.nanmax(points[:, 1]) - np.nanmin(points[:, 1])), HEIGHT)
    x0, y0 = np.clip(middle - np.array([LEFT_PX, TALL_PX]) / (2 * scale), 0, None)
    part = cv2.warpAffine(
        image, np.array([[scale, 0, -x0 * scale], [0, scale, -y0 * scale]]), (LEFT_PX, TALL_PX), flags=cv2.INTER_CUBIC
    )
    at = np.round((points - (x0, y0)) * scale * 16)
    for width, shade in ((9, 0.0), (5, 1.0)):
        for child, parent in enumerate(motion.parents):
            ends = at[[child, parent]]
            if parent >= 0 and np.isfinite(ends).all():
                start, end = (tuple(int(v) for v in point) for point in ends)
                cv2.line(part, start, end, _bgr(colour_of(motion.joints[child]), shade), width, cv2.LINE_AA, shift=4)
    for point in at[np.isfinite(at).all(axis=1)]:
        centre = tuple(int(v) for v in point)
        cv2.circle(part, centre, 7 * 16, (255, 255, 255), -1, cv2.LINE_AA, shift=4)
        cv2.circle(part, centre, 7 * 16, (40, 40, 40), 1, cv2.LINE_AA, shift=4)
    return part[..., ::-1]


def _bgr(colour: str, shade: float) -> tuple[float, ...]:
    return tuple(shade * int(colour[i : i + 2], 16) for i in (5, 3, 1))


def seen_from(points: np.ndarray, azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """(..., 2) m right and up of world points (..., 3), seen from far away."""
    a, e = np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg)
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    return np.asarray(points) @ np.stack([right, up], axis=1)


def draw_motion(axes: Any, motion: Motion, path: np.ndarray) -> None:
    """The body at the shown frame and earlier, on the ground, with the camera's path and its view."""
    level = np.array([0.0, 0.0, motion.joints3d[..., 2].min()])
    body, path = motion.joints3d - level, path - level
    walked = body[SHOWN, 0] - body[0, 0]
    view = (np.rad2deg(np.arctan2(walked[1], walked[0])) - 90.0 + TURN_DEG, ELEVATION_DEG)

    def line(points: np.ndarray, **style: Any) -> None:
        axes.plot(*seen_from(points, *view).T, solid_capstyle="round", **style)

    def skeleton(joints: np.ndarray, width: float, colour: str, ground: bool) -> None:
        for child, parent in enumerate(motion.parents):
            if parent >= 0:
                ends = joints[[child, parent]] * ((1, 1, 0) if ground else (1, 1, 1))
                line(ends, color=colour or colour_of(motion.joints[child]), linewidth=width)

    middle = 0.5 * (body[SHOWN, 0] + body[0, 0]) * (1, 1, 0)
    for step in np.arange(-GROUND_M, GROUND_M + 1.0):
        for ends in ([[step, -GROUND_M, 0], [step, GROUND_M, 0]], [[-GROUND_M, step, 0], [GROUND_M, step, 0]]):
            line(np.array(ends) + np.round(middle), color="#e6e9ee", linewidth=0.9)
    line(path * (1, 1, 0), color="#ecd9ab", linewidth=1.4)
    frames = [*EARLIER, SHOWN]
    for frame in frames:
        skeleton(body[frame], 3.0, "#d3d9e0", ground=True)
    line(path[: SHOWN + 1], color="#f0a202", linewidth=2.6)
    line(path[SHOWN:], color="#f0a202", linewidth=1.6, linestyle=(0, (2, 2)))
    for frame in sorted(EARLIER, key=lambda f: -seen_from(body[f, 0] * (1, 1, 0), *view)[1]):
        skeleton(body[frame], 3.2, "#8f9bab", ground=False)
    x, y = np.tan(np.deg2rad(FIELD_DEG / 2)) * np.array([1.0, HEIGHT / WIDTH])
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) * 0.7 @ motion.camera_rotation[SHOWN]
    for i in range(4):
        line(path[SHOWN] + np.array([[0, 0, 0], corners[i]]), color="#4a4f57", linewidth=1.6)
        line(path[SHOWN] + corners[[i, (i + 1) % 4]], color="#4a4f57", linewidth=1.6)
    skeleton(body[SHOWN], 7.0, "", ground=False)
    flat = seen_from(np.concatenate([body[frames].reshape(-1, 3), path]), *view)
    low, high = flat.min(axis=0) - 0.25, flat.max(axis=0) + 0.25
    half = max((high - low)[0] / RIGHT_PX, (high - low)[1] / TALL_PX) / 2 * np.array([RIGHT_PX, TALL_PX])
    centre = (low + high) / 2
    axes.set(xlim=centre[0] + half[0] * np.array([-1, 1]), ylim=centre[1] + half[1] * np.array([-1, 1]))
    axes.set_axis_off()


def main() -> None:
    """Draw and write the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    image, motion, path = capture()
    figure = Figure(figsize=((LEFT_PX + RIGHT_PX) / 100, TALL_PX / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    share = LEFT_PX / (LEFT_PX + RIGHT_PX)
    axes = figure.add_axes((0, 0, share, 1))
    axes.imshow(overlay(image, motion))
    axes.set_axis_off()
    draw_motion(figure.add_axes((share, 0, 1 - share, 1)), motion, path)
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., 2::-1]
    cv2.imwrite(str(ROOT / "docs" / "capture.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
