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
    """

    def __init__(self, keep_s: float = 3.0) -> None:
        self._keep_ns = int(keep_s * NS)
        self._poses: deque[tuple[int, np.ndarray, np.ndarray]] = deque()
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
        self._poses.append((state.stamp_ns, camera, place))
        while state.stamp_ns - self._poses[0][0] > self._keep_ns:
            self._poses.popleft()

    def reached(self, stamp_ns: int) -> bool:
        """Whether a state of this instant or a later one is known."""
        return bool(self._poses) and stamp_ns <= self._poses[-1][0]

    def at(self, stamp_ns: int) -> CameraPose | None:
        """Pose at an instant; None outside the states."""
        if not self.reached(stamp_ns) or stamp_ns < self._poses[0][0]:
            return None
        later = self._poses[-1]
        for pose in reversed(self._poses):
            if pose[0] <= stamp_ns:
                part = (stamp_ns - pose[0]) / max(later[0] - pose[0], 1)
                position = (1 - part) * pose[2] + part * later[2]
                return CameraPose(camera_rotation(slerp(pose[1], later[1], part)), position)
            later = pose
        return None
