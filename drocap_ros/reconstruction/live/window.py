"""A live window before and after its adjustment, and the work that one may cost: a late node takes fewer images."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from drocap_ros.background import Background
from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.alignment import LIMBS_PER_STATURE, limb_lengths
from drocap_ros.keypoints import Keypoints2D

#: Share of the allowed time above which the next window gets coarser: a tenth is left for its spread.
_TOO_LONG = 0.9
#: Time (s) after the first costly search without a result, and the longest after more of them; each doubles it.
_FIRST_PAUSE_S = 4.0
_LONGEST_PAUSE_S = 60.0


#: Images without fixed points that are nearer than this to one with points are left out.
_NEAR_NS = 120_000_000


class Window(NamedTuple):
    """F frames of one subject.

    stamp_ns : (F,) increasing
    keypoints : of BODY_17, with confidence and covariance (NaN where unknown)
    initial_joints : (F, 17, 3) m, camera axes
    subject : differs for every subject and for every pass of time
    camera : as reported; None = unknown
    assumed_focal_px : of the lens where the camera is unknown; None = distant
    background : fixed points of the scene in its images; None = there are none
    image_size : width and height px
    track_id : of the subject
    known_ns : stamps of the newest state of the vehicle and fixed points that were known, 0 = none
    """

    stamp_ns: np.ndarray
    keypoints: Keypoints2D
    initial_joints: np.ndarray
    subject: int = 0
    camera: CameraPath | None = None
    assumed_focal_px: float | None = None
    background: Background | None = None
    image_size: tuple[int, int] = (0, 0)
    track_id: int = 0
    known_ns: tuple[int, int] = (0, 0)

    @property
    def height_m(self) -> float:
        """Stature that the initial poses assume."""
        known = np.isfinite(self.initial_joints).all(axis=(1, 2))
        return float(np.median(limb_lengths(self.initial_joints[known]).sum(axis=-1)) / LIMBS_PER_STATURE)

    def every(self, stride: int) -> Window:
        """Every ``stride``-th frame, counted back from the newest.

        Where fixed points are followed in some images alone, as on a busy machine, the images near these are left out:
        the camera's path is known in images with points.
        """
        count = len(self.stamp_ns)
        kept = np.ones(count, bool)
        if self.background is not None and len(self.background):
            kept[:] = np.isin(np.arange(count), self.background.frame)
            seen_ns = self.stamp_ns[kept]
            after = np.minimum(np.searchsorted(seen_ns, self.stamp_ns), len(seen_ns) - 1)
            gap_ns = np.abs(self.stamp_ns - np.stack([seen_ns[after], seen_ns[np.maximum(after - 1, 0)]]))
            kept |= gap_ns.min(axis=0) > _NEAR_NS
            kept[-1] = True
        # The last one of each group of frames.
        places = np.flatnonzero(kept)[::-1]
        _, first = np.unique((count - 1 - places) // stride, return_index=True)
        return self.frames(places[first][::-1])

    def frames(self, use: slice | np.ndarray) -> Window:
        """Some of the frames."""
        camera = None if self.camera is None else self.camera.of_images(use)
        kept = np.arange(len(self.stamp_ns))[use]
        return self._replace(
            background=None if self.background is None else self.background.of_frames(kept),
            stamp_ns=self.stamp_ns[use],
            keypoints=self.keypoints[use],
            initial_joints=self.initial_joints[use],
            camera=camera,
        )


@dataclass(frozen=True)
class Effort:
    """Every ``stride``-th image, counted from the newest.

    steps : limits of the first and of the final adjustment of the default method; None = the configured ones
    """

    stride: int = 1
    steps: tuple[int, int] | None = None


class EffortControl:
    """Chooses the stride of the next window from the duration of the last adjustment.

    allowed_s : for one adjustment
    max_stride : the coarsest
    """

    def __init__(self, allowed_s: float, max_stride: int) -> None:
        self._allowed_s, self._max_stride = allowed_s, max_stride
        self.stride = 1

    def record(self, seconds: float) -> None:
        """Record the duration of an adjustment with the present stride."""
        if seconds > _TOO_LONG * self._allowed_s:
            self.stride = min(self.stride + 1, self._max_stride)
        # A finer window has to stay below half of that, so that strides do not alternate.
        elif self.stride > 1 and seconds * self.stride / (self.stride - 1) < 0.5 * _TOO_LONG * self._allowed_s:
            self.stride -= 1


class Retry:
    """The pause after searches that found nothing, in image time; ``last_s`` : the last pause, 0 = there was none."""

    def __init__(self) -> None:
        self._until_ns, self.last_s = 0, 0.0

    def due(self, stamp_ns: int) -> bool:
        """Whether the window whose newest image has this stamp is searched."""
        return stamp_ns >= self._until_ns

    def failed(self, stamp_ns: int) -> None:
        """The search in the window of this stamp found nothing."""
        self.last_s = min(2.0 * self.last_s, _LONGEST_PAUSE_S) or _FIRST_PAUSE_S
        self._until_ns = stamp_ns + round(self.last_s * 1e9)


class TelemetryUse(Enum):
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
    """The camera of a window in ``map``, or in ``odom``, the frame of a path by the picture alone.

    rotation : (F, 3, 3) world -> camera; position : (F, 3) m; both adjusted
    correction : (6,) of the newest frame: position (m) and rotation vector (rad, camera axes) that correct the
        reported ones
    path : 0 = in ``map``, else the number of the path in ``odom``
    """

    rotation: np.ndarray
    position: np.ndarray
    correction: np.ndarray
    path: int = 0


@dataclass(frozen=True)
class AdjustedWindow:
    """Poses of a window: joints3d (F, 17, 3) m and covariance (F, 17, 6) m^2.

    They are in camera axes with the pelvis at the origin, or, where ``in_map`` is known, in ``map`` (ENU) and metric,
    or in ``odom`` (z up); then only the frames with a result there are in the window.

    effort : repeats the adjustment bit for bit
    telemetry : use of the reported camera; reason : in words, why it was refused
    calibration : in words, the constant errors of the reports by fixed points; "" = they were not used
    picture : in words, the path by the picture alone, or why there is none; lost : whether it has just ended
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
    telemetry: TelemetryUse = TelemetryUse.NONE
    reason: str = ""
    calibration: str = ""
    picture: str = ""
    lost: bool = False
    in_map: InMap | None = None
