"""The live graph's method without the graph: the sliding windows of initializer and bundle adjuster, offline.

The same objects as in the nodes do the work, and values pass through float32 where the nodes send them as messages,
so that the same keypoints give the same poses, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.observation import PoseObservation
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, WindowAdjuster
from drocap_ros.reconstruction.live.effort import Effort
from drocap_ros.reconstruction.live.frame_buffer import AdjustmentWindow
from drocap_ros.reconstruction.live.initializer import AdjustedWindow, InitialPose, SlidingWindowInitializer
from drocap_ros.reconstruction.reconstruction_config import BundleAdjusterConfig, InitializerConfig


class LivePose(NamedTuple):
    """What the initializer publishes for one image: joints (15, 3) float32 m in camera axes.

    anew : the subject or the pass of time is another than the image's before
    """

    observation: PoseObservation
    joints3d: np.ndarray
    pose: InitialPose
    anew: bool


class LiveWindow(NamedTuple):
    """What the bundle adjuster publishes: stamps (F,) and joints (F, 15, 3) float32 m in camera axes."""

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    iterations: int
    stop_reason: str
    window: AdjustedWindow


def live_poses(
    observations: Iterable[PoseObservation],
    initializer: InitializerConfig,
    adjuster: BundleAdjusterConfig,
    adjusted: Callable[[int], Effort | None] | None = None,
) -> Iterator[LivePose | LiveWindow]:
    """Poses and windows in the order in which the live graph comes to them; memory is that of one window.

    Parameters
    ----------
    observations : in the order of their messages; those without a subject, or of no person that the initializer can
        use, are passed over as the nodes do, and so are late and duplicate ones
    adjusted : tells by the stamp of a window's newest image how the live graph adjusted it, or None where it did not
        (it leaves one out while the one before is still running); without it all that are due, with full effort
    """
    start, window, solver = SlidingWindowInitializer(initializer), AdjustmentWindow(adjuster), WindowAdjuster(adjuster)
    for observation in observations:
        if not observation.has_subject:
            continue
        try:
            pose = start.push(
                observation.stamp_ns,
                observation.keypoints.astype(np.float64),
                observation.confidence.astype(np.float64),
                observation.covariance.astype(np.float64),
                observation.track_id,
            )
        except InputError:
            continue
        if pose is None:
            continue
        joints = pose.joints3d.astype(np.float32)
        yield LivePose(observation, joints, pose, start.arrival.anew)
        due = window.push(observation, joints.astype(np.float64))
        effort = (Effort() if adjusted is None else adjusted(observation.stamp_ns)) if due else None
        if effort is None:
            continue
        try:
            result = solver.adjust(window.snapshot(), effort)
        except SOLVER_ERRORS:
            continue
        yield LiveWindow(
            result.stamp_ns,
            result.joints3d.astype(np.float32),
            result.iterations,
            result.stop_reason,
            result,
        )
