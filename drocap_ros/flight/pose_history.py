"""The camera's pose at the instant of an image, from the vehicle's states around it.

Positions are those of ``vehicle_filter.py``, not the reported ones: an error that wanders does not appear as motion of
the subject, nor noise of the height as its range from the ground.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.frames import camera_rotation
from drocap_ros.flight.vehicle_state import VehicleState
from drocap_ros.geometry.rotations import slerp
from drocap_ros.stamps import NS


class CameraPose(NamedTuple):
    """(3, 3) world ENU -> optical, and (3,) m ENU."""

    rotation: np.ndarray
    position: np.ndarray


class PoseHistory:
    """States of the last seconds, by their stamps.

    Parameters
    ----------
    keep_s : how far back
    extrapolate_s : longest extrapolation beyond the newest state
    """

    def __init__(self, keep_s: float = 3.0, extrapolate_s: float = 0.15) -> None:
        self._keep_ns, self._extrapolate_ns = int(keep_s * NS), int(extrapolate_s * NS)
        self._poses: deque[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = deque()
        #: (3,) m, reported minus filtered position now: add it to a position from here.
        self.offset: np.ndarray = np.zeros(3)

    def add(self, state: VehicleState, place: np.ndarray) -> None:
        """Take a state; without position or camera's attitude it is left out.  A stamp that goes back clears all.

        place : (3,) m, its filtered position
        """
        camera = state.gimbal_orientation_xyzw
        if not (np.isfinite(camera).all() and np.isfinite(state.position_enu_m).all()):
            return
        if self._poses and state.stamp_ns <= self._poses[-1][0]:
            self._poses.clear()
        self.offset = state.position_enu_m - place
        self._poses.append((state.stamp_ns, camera, place, np.nan_to_num(state.velocity_enu_m_s)))
        while state.stamp_ns - self._poses[0][0] > self._keep_ns:
            self._poses.popleft()

    def at(self, stamp_ns: int) -> CameraPose | None:
        """Pose at an instant; None outside the states."""
        if not self._poses or stamp_ns < self._poses[0][0] - self._extrapolate_ns:
            return None
        newest = self._poses[-1]
        if stamp_ns >= newest[0]:
            gap_ns = stamp_ns - newest[0]
            if gap_ns > self._extrapolate_ns:
                return None
            before = self._poses[-2] if len(self._poses) > 1 else newest
            step = newest[0] - before[0]
            camera = slerp(before[1], newest[1], 1.0 + min(gap_ns / step, 3.0)) if step > 0 else newest[1]
            return CameraPose(camera_rotation(camera), newest[2] + newest[3] * gap_ns / NS)
        later = newest
        for pose in reversed(self._poses):
            if pose[0] <= stamp_ns:
                part = (stamp_ns - pose[0]) / (later[0] - pose[0])
                position = (1 - part) * pose[2] + part * later[2]
                return CameraPose(camera_rotation(slerp(pose[1], later[1], part)), position)
            later = pose
        return CameraPose(camera_rotation(later[1]), later[2])
