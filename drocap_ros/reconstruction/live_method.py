"""The live graph's method without the graph: the sliding windows of initializer and bundle adjuster, offline.

The same objects as in the nodes do the work, and values pass through float32 where the nodes send them as messages,
so that the same keypoints give the same poses, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.perception.observation import PoseObservation
from drocap_ros.reconstruction.adjustment_window import AdjustmentWindow
from drocap_ros.reconstruction.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.window import SlidingWindowInitializer, adjust_window


class LivePose(NamedTuple):
    """What the initializer publishes for one image: joints (15, 3) float32 m in camera axes."""

    observation: PoseObservation
    joints3d: np.ndarray


class LiveWindow(NamedTuple):
    """What the bundle adjuster publishes: stamps (F,) and joints (F, 15, 3) float32 m in camera axes."""

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    iterations: int
    stop_reason: str


def live_poses(
    observations: Iterable[PoseObservation],
    initializer: InitializerConfig,
    adjuster: BundleAdjusterConfig,
    adjusted: Callable[[int], bool] | None = None,
) -> Iterator[LivePose | LiveWindow]:
    """Poses and windows in the order in which the live graph comes to them; memory is that of one window.

    Parameters
    ----------
    observations : in the order of their messages; those without a subject, or of no person that the initializer can
        use, are passed over as the nodes do
    adjusted : tells by the stamp of a window's newest image whether the live graph adjusted it (it leaves one out
        while the one before is still running); None = all that are due
    """
    start, window = SlidingWindowInitializer(initializer), AdjustmentWindow(adjuster)
    for observation in observations:
        if not observation.has_subject:
            continue
        try:
            pose = start.push(
                observation.stamp_ns,
                observation.keypoints.astype(np.float64),
                observation.confidence.astype(np.float64),
                observation.covariance.astype(np.float64),
            )
        except InputError:
            continue
        joints = pose.joints3d.astype(np.float32)
        yield LivePose(observation, joints)
        due = window.push(observation, joints.astype(np.float64))
        if not due or (adjusted is not None and not adjusted(observation.stamp_ns)):
            continue
        try:
            result = adjust_window(*window.snapshot(), adjuster)
        except (InputError, np.linalg.LinAlgError, FloatingPointError):
            continue
        yield LiveWindow(result.stamp_ns, result.joints3d.astype(np.float32), result.iterations, result.stop_reason)
