"""Several persons in one report: their poses in one world, on the times of the one who leads the page."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drocap_ros.clip import Progress
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.report.statistics import SMOOTH_S


def leader(people: Mapping[int, Motion]) -> int:
    """The person with whom the camera was found, whose motion covers all images; else that of most images."""
    found = next(iter(people.values())).meta.get("camera_found_with")
    return max(people, key=lambda number: (number == found, len(people[number].stamp_ns), -number))


def together(people: Mapping[int, Motion]) -> dict[int, Motion]:
    """The motions on the images of the leader's, poses and keypoints NaN where a person is not in view.

    Without a world each is placed by its size in the image, through the lens that is assumed for real pictures.
    """
    stamp_ns = people[leader(people)].stamp_ns
    found = {}
    for number, motion in people.items():
        joints = motion.joints3d if motion.frame == "world" else motion.joints3d + _places(motion)[:, None]
        shown = np.where(_in_view(motion)[:, None, None], joints, np.nan)
        rows = np.searchsorted(stamp_ns, motion.stamp_ns).clip(0, len(stamp_ns) - 1)
        pose = np.full((len(stamp_ns), *shown.shape[1:]), np.nan)
        keypoints = np.full((len(stamp_ns), *motion.keypoints.shape[1:]), np.nan)
        pose[rows], keypoints[rows] = shown, motion.keypoints
        found[number] = dataclasses.replace(motion, stamp_ns=stamp_ns, joints3d=pose, keypoints=keypoints)
    return found


def _in_view(motion: Motion) -> np.ndarray:
    """(F,) bool: frames near an image that shows the person."""
    seen = np.flatnonzero(np.isfinite(motion.keypoints).any(axis=(1, 2)))
    times = motion.stamp_ns * 1e-9
    if not len(seen):
        return np.zeros(len(times), bool)
    after = np.searchsorted(seen, np.arange(len(times))).clip(0, len(seen) - 1)
    near = [np.abs(times - times[seen[at]]) for at in (after, np.maximum(after - 1, 0))]
    # Time (s) from the last image that shows a person, or to the next one, over which the pose is drawn.
    return np.asarray(np.minimum(*near) <= 0.5)


def _places(motion: Motion) -> np.ndarray:
    """(F, 3) m, the pelvis from the camera in its axes, by the size of the pose in the image."""
    from scipy.ndimage import gaussian_filter1d

    images = motion.meta.get("images")
    size = np.array(images["size"] if isinstance(images, dict) else np.nanmax(motion.keypoints, axis=(0, 1)), float)
    focal = BundleAdjusterConfig.assumed_focal * float(size.max())
    seen = np.isfinite(motion.keypoints).all(axis=2)[..., None]
    xy, px = (np.where(seen, values, np.nan) for values in (motion.joints3d[..., :2], motion.keypoints))
    with np.errstate(invalid="ignore", divide="ignore"):
        count = seen.sum(axis=1)
        mean_xy, mean_px = np.nansum(xy, axis=1) / count, np.nansum(px, axis=1) / count
        from_mean = xy - mean_xy[:, None], px - mean_px[:, None]
        px_per_m = np.nansum(from_mean[0] * from_mean[1], axis=(1, 2)) / np.nansum(from_mean[0] ** 2, axis=(1, 2))
        depth = focal / px_per_m
        across = (mean_px - (size - 1) / 2) / focal * depth[:, None] - mean_xy
    places = np.column_stack([across, depth])
    known = np.flatnonzero(np.isfinite(places).all(axis=1) & (px_per_m > 0.0))
    if not len(known):
        return np.zeros((len(seen), 3))
    at = np.arange(len(seen))
    filled = np.stack([np.interp(at, known, places[known, axis]) for axis in range(3)], axis=1)
    step_s = float(np.median(np.diff(motion.stamp_ns))) * 1e-9 if len(seen) > 1 else 1.0
    return np.asarray(gaussian_filter1d(filled, SMOOTH_S / step_s, axis=0, mode="nearest"))


def save_people_report(
    path: str | Path,
    people: Mapping[int, Motion],
    *,
    video: Path | None = None,
    command: str = "",
    progress: Progress | None = None,
) -> None:
    """Write one report of several persons; as :func:`~drocap_ros.report.page.save_report`."""
    from drocap_ros.report.motion_images import read_motion_images
    from drocap_ros.report.page import render_report

    placed = together(people)
    lead = leader(people)
    images = None
    if video is not None:
        everybody = np.concatenate([motion.keypoints for motion in placed.values()], axis=1)
        images = read_motion_images(video, dataclasses.replace(people[lead], keypoints=everybody), progress)
    text = render_report(people[lead], images, command, {lead: people[lead], **people}, placed)
    Path(path).write_text(text, encoding="utf-8")
