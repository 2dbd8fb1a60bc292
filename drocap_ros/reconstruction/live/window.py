"""A live window before and after its adjustment."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.camera_history import WindowCamera
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.live.effort import Effort


class Window(NamedTuple):
    """F frames of one subject.

    stamp_ns : (F,) increasing
    keypoints : of BODY_17, with confidence and covariance (NaN where unknown)
    initial_joints : (F, 17, 3) m, camera axes
    subject : differs for every subject and for every pass of time
    camera : as reported; None = unknown
    """

    stamp_ns: np.ndarray
    keypoints: Keypoints2D
    initial_joints: np.ndarray
    subject: int = 0
    camera: WindowCamera | None = None

    def every(self, stride: int) -> Window:
        """Every ``stride``-th frame, counted back from the newest."""
        return self.frames(slice((len(self.stamp_ns) - 1) % stride, None, stride))

    def frames(self, use: slice) -> Window:
        """Some of the frames."""
        camera = None if self.camera is None else self.camera.frames(use)
        return Window(self.stamp_ns[use], self.keypoints[use], self.initial_joints[use], self.subject, camera)


class Telemetry(Enum):
    """Use of the camera's reported poses in a window.

    NONE : there are none; LATE : the newest images have none, or too few have one; REFUSED : they cannot be true;
    UNSCALED : the scale is not measured yet; USED : the poses of the window are in ``map``
    """

    NONE = auto()
    LATE = auto()
    REFUSED = auto()
    UNSCALED = auto()
    USED = auto()


class InMap(NamedTuple):
    """The camera of a window in ``map``.

    rotation : (F, 3, 3) world -> camera; position : (F, 3) m; both adjusted
    correction : (6,) of the newest frame: position (m) and rotation vector (rad, camera axes) that correct the
        reported ones
    """

    rotation: np.ndarray
    position: np.ndarray
    correction: np.ndarray


@dataclass(frozen=True)
class AdjustedWindow:
    """Poses of a window: joints3d (F, 17, 3) m and covariance (F, 17, 6) m^2.

    By the paper's equations 15 joints from initial poses of 15 joints, as older recordings hold.

    They are in camera axes with the pelvis at the origin, or, where ``in_map`` is known, in ``map`` (ENU) and metric;
    then only the frames with a result there are in the window.

    effort : repeats the adjustment bit for bit
    telemetry : use of the reported camera; reason : in words, why it was refused
    """

    stamp_ns: np.ndarray
    joints3d: np.ndarray
    covariance: np.ndarray
    confidence: np.ndarray
    reprojection_rms_px: np.ndarray
    iterations: int
    cost: float
    stop_reason: str
    cost_terms: dict[str, float]
    effort: Effort = field(default_factory=Effort)
    telemetry: Telemetry = Telemetry.NONE
    reason: str = ""
    in_map: InMap | None = None
