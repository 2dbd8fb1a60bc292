"""Recordings of any length in overlapping windows: linear time, bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.paper.normalize import NormalizedTracks, normalize_tracks
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_last


class WindowResult(NamedTuple):
    """Poses (F, P, 3) in camera axes, x and y in the window's normalized image; the solver's report.

    sigma : (F, P, 2) expected error of x, y (each) and of depth, in the same unit; None = the method has none
    still : (F, 2) probability that the right and the left foot rest, None = the method has none
    """

    poses: np.ndarray
    cost_terms: dict[str, float]
    iterations: int
    stop_reason: str
    sigma: np.ndarray | None = None
    still: np.ndarray | None = None


def over_windows(data: MethodInput, solve: Callable[[slice, NormalizedTracks], WindowResult]) -> CameraPoses:
    """Solve window by window and cross-fade the poses where windows overlap."""
    keypoints, overlap = data.keypoints, data.adjuster.overlap_frames
    sigma: np.ndarray | None = None
    still: np.ndarray | None = None
    out, weight = np.zeros((*keypoints.xy.shape[:2], 3)), np.zeros(len(keypoints))
    iterations, terms, stops = 0, dict[str, float](), set[str]()
    for rows, n in normalized_windows(keypoints, data.adjuster.window_frames, overlap):
        found = solve(rows, n)
        fade = fade_weights(rows, len(keypoints), overlap)
        in_image = found.poses * n.scale_px
        in_image[..., :2] += n.centre_px[:, None]
        out[rows] += fade[:, None, None] * in_image
        weight[rows] += fade
        if found.sigma is not None:
            sigma = np.zeros(keypoints.xy.shape) if sigma is None else sigma
            sigma[rows] += fade[:, None, None] * found.sigma * n.scale_px
        if found.still is not None:
            still = np.zeros((len(keypoints), 2)) if still is None else still
            still[rows] += fade[:, None] * found.still
        iterations += found.iterations
        stops.add(found.stop_reason)
        for name, value in found.cost_terms.items():
            terms[name] = terms.get(name, 0.0) + value
        data.progress("ba", rows.stop / len(keypoints))
    sigma = None if sigma is None else sigma / weight[:, None, None]
    still = None if still is None else still / weight[:, None]
    return CameraPoses(
        *split(out / weight[:, None, None]), {}, iterations, ", ".join(sorted(stops)), terms, sigma, still
    )


def placed(poses: np.ndarray, w: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Poses (F, P, 3) translated in the image to fit the joints ``w`` (F, P, 2) best."""
    moved = poses.copy()
    moved[..., :2] += Projection(w, information).translation(frames_last(poses[..., :2])).T[:, None]
    return moved


def split(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centred poses (F, P, 3), and their centres in the image (F, 2)."""
    middle = poses.mean(axis=1, keepdims=True)
    return poses - middle, middle[:, 0, :2]


def windows(frames: int, length: int, overlap: int) -> list[slice]:
    """Windows of equal length, at most ``length``; neighbours share about ``overlap`` frames."""
    if frames <= length:
        return [slice(0, frames)]
    overlap = min(overlap, length // 2)
    count = int(np.ceil((frames - overlap) / (length - overlap)))
    # The shortest windows with this overlap: 1000 frames take three windows of 374, not of 480.
    length = int(np.ceil((frames + (count - 1) * overlap) / count))
    begins = np.round(np.linspace(0, frames - length, count)).astype(int)
    return [slice(int(begin), int(begin) + length) for begin in begins]


def normalized_windows(keypoints: Keypoints2D, length: int, overlap: int) -> Iterator[tuple[slice, NormalizedTracks]]:
    """Normalized tracks, window by window."""
    for rows in windows(len(keypoints), length, overlap):
        yield rows, normalize_tracks(keypoints[rows])


def fade_weights(rows: slice, frames: int, overlap: int) -> np.ndarray:
    """Weights of a window's frames that rise over the overlap with the one before and fall over that with the next."""
    count = rows.stop - rows.start
    ramp = np.minimum(np.arange(1, count + 1) / (overlap + 1.0), 1.0)
    return (ramp if rows.start > 0 else np.ones(count)) * (ramp[::-1] if rows.stop < frames else np.ones(count))
