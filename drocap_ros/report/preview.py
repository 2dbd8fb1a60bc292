"""``preview.png``: poses of a motion in rows, as in the paper's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from drocap_ros.motion import Motion
from drocap_ros.report.statistics import mean_known
from drocap_ros.skeleton import side_of

_COLOURS = {"right": "#c0392b", "left": "#2471a3", "middle": "#444444"}
_POSES = 7


def save_preview(path: Path, motion: Motion) -> None:
    """Draw 2D keypoints and two views of poses spread over the frames with the person, and the reprojection error."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    frames = shown_frames(motion)
    with mpl.rc_context({"font.size": 8}):
        layout = ConstrainedLayoutEngine(rect=(0.02, 0, 0.98, 1))
        figure = Figure(figsize=(1.9 * _POSES, 8.2), layout=layout)
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(4, _POSES, height_ratios=(1, 1, 1, 0.7))
        body, limit = _upright_body(motion)
        for column, frame in enumerate(frames):
            seconds = (motion.stamp_ns[frame] - motion.stamp_ns[0]) * 1e-9
            flat = motion.keypoints[frame]
            _draw(figure.add_subplot(grid[0, column]), flat * (1, -1), motion, None, f"{seconds:.1f} s")
            _draw(figure.add_subplot(grid[1, column]), body[frame][:, [0, 2]], motion, limit, "")
            _draw(figure.add_subplot(grid[2, column]), body[frame][:, [1, 2]], motion, limit, "")
        for row, name in enumerate(("2D keypoints", "3D, camera's view", "3D, from the side")):
            figure.text(0.002, 0.86 - 0.265 * row, name, rotation=90, va="center", fontsize=9)
        _plot_error(figure.add_subplot(grid[3, :]), motion)
        figure.savefig(path, dpi=100)


def shown_frames(motion: Motion) -> np.ndarray:
    """Indices of the poses shown, spread over the frames with a keypoint; over all frames if there is none."""
    seen = np.isfinite(motion.keypoints).all(axis=2).any(axis=1)
    there = np.flatnonzero(seen if seen.any() else np.ones_like(seen))
    places: np.ndarray = np.unique(np.linspace(0, len(there) - 1, _POSES).round().astype(int))
    return there[places]


def _upright_body(motion: Motion) -> tuple[np.ndarray, float]:
    """Pelvis-centred poses in axes right, away from the camera, up, and the half-width that shows them all."""
    centred = motion.joints3d - motion.joints3d[:, :1]
    if motion.frame == "camera":
        body = centred[..., [0, 2, 1]] * (1, 1, -1)
    else:
        # Turn about the vertical only, so that the figure keeps gravity: right is the camera's right.
        right = motion.camera_rotation[:, 0] * (1, 1, 0)
        right = right / np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
        up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), right.shape)
        axes = np.stack([right, np.cross(up, right), up], axis=1)
        body = np.einsum("fij,fpj->fpi", axes, centred)
    return body, float(np.nanmax(np.abs(body), initial=0.1)) * 1.05


def _draw(axes: Any, points: np.ndarray, motion: Motion, limit: float | None, title: str) -> None:
    for child, parent in enumerate(motion.parents):
        if parent >= 0:
            colour = _COLOURS[side_of(motion.joints[child], motion.joints)]
            axes.plot(*points[[parent, child]].T, color=colour, linewidth=1.8, solid_capstyle="round")
    axes.set_aspect("equal")
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])
    if limit is not None:
        axes.set_xlim(-limit, limit)
        axes.set_ylim(-limit, limit)


def _plot_error(axes: Any, motion: Motion) -> None:
    seconds = (motion.stamp_ns - motion.stamp_ns[0]) * 1e-9
    axes.plot(seconds, np.sqrt(mean_known(np.square(motion.reprojection_px), 1)), color="#444444", linewidth=1)
    axes.set_xlabel("s")
    axes.set_ylabel("reprojection RMS, px")
    axes.set_ylim(bottom=0)
    axes.set_xlim(0, seconds[-1] or 1.0)
