"""The live graph's method offline: initializer and bundle adjuster over a stream of observations.

The nodes use the same objects, and values pass through float32 as in their messages, so the same keypoints give the
same poses bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.errors import InputError
from drocap_ros.keypoints import PoseObservation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig, InitializerConfig
from drocap_ros.reconstruction.live.adjuster import SOLVER_ERRORS, LiveAdjuster
from drocap_ros.reconstruction.live.frame_buffer import FrameBuffer
from drocap_ros.reconstruction.live.initializer import InitialPose, LiveInitializer
from drocap_ros.reconstruction.live.window import AdjustedWindow, Effort
from drocap_ros.stamps import StampValidator


class LivePose(NamedTuple):
    """An image's initial pose as published: joints (17, 3) float32 m in camera axes.

    restarted : the subject, the image size or the pass of time differs from the image before
    """

    observation: PoseObservation
    joints3d: np.ndarray
    pose: InitialPose
    restarted: bool


class LiveWindow(NamedTuple):
    """An adjusted window as published: joints (F, 17, 3) float32 m in the frame of the window."""

    joints3d: np.ndarray
    window: AdjustedWindow


def live_poses(
    observations: Iterable[PoseObservation],
    initializer: InitializerConfig,
    adjuster: BundleAdjusterConfig,
    effort_at: Callable[[int], Effort | None] | None = None,
    camera_at: Callable[[np.ndarray, tuple[int, int]], CameraPath | None] | None = None,
    points_at: Callable[[np.ndarray], Background | None] | None = None,
) -> Iterator[LivePose | LiveWindow]:
    """Poses and windows in the order of the live graph; memory is that of one window.

    observations : in the order of their messages; those that the nodes drop are skipped
    effort_at : gives by the stamp of a window's newest image the effort of the live graph, None where it skipped the
        window (one is skipped while another is running); without it all windows that are due, with full effort
    camera_at : gives the reported camera at the stamps (F,) of a window that is adjusted and the size (width, height)
        px of its newest image; without it none is known
    points_at : gives the fixed points of the scene in the images of a window that is adjusted
    """
    initial, buffer, solver = LiveInitializer(initializer), FrameBuffer(adjuster), LiveAdjuster(adjuster)
    arrivals = StampValidator()  # of pose3d/initial at the adjuster's node
    for observation in observations:
        pose = _initial_pose(initial, observation)
        if pose is None:
            continue
        joints = pose.joints3d.astype(np.float32)
        yield LivePose(observation, joints, pose, initial.event.restarted)
        try:
            arrivals.check(*divmod(observation.stamp_ns, 10**9))
        except InputError:
            continue
        due = buffer.push(observation, joints.astype(np.float64))
        effort = (Effort() if effort_at is None else effort_at(observation.stamp_ns)) if due else None
        if effort is None:
            continue
        window = buffer.window()
        if camera_at is not None:
            window = window._replace(camera=camera_at(window.stamp_ns, observation.image_size))
        if points_at is not None:
            window = window._replace(background=points_at(window.stamp_ns))
        try:
            result = solver.adjust(window, effort)
        except SOLVER_ERRORS:
            continue
        yield LiveWindow(result.joints3d.astype(np.float32), result)


def _initial_pose(initial: LiveInitializer, observation: PoseObservation) -> InitialPose | None:
    """The pose that the initializer's node publishes; None = none."""
    if not observation.has_subject:
        return None
    try:
        return initial.push(observation)
    except InputError:
        return None
