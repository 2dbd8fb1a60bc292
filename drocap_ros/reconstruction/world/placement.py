"""Scale and placement of the reconstructed body: px to metres, camera to world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.geometry.bones import LIMBS_PER_STATURE, limb_lengths
from drocap_ros.reconstruction.world.metric_scale import ScaleEstimate, estimate_scale
from drocap_ros.skeleton import BODY_15

#: Standard deviation (s) of the average of the person's image size: a drone changes its range slowly.
_SIZE_SMOOTHING_S = 1.0


def metres_per_px(joints_px: np.ndarray, stamp_ns: np.ndarray, height_m: float) -> np.ndarray:
    """(F,) metres per px that give the body of poses (F, 15, 3) px the limb lengths of a person of ``height_m``."""
    total = limb_lengths(joints_px).sum(-1)
    size = np.maximum(smooth_over_time(total, stamp_ns, _SIZE_SMOOTHING_S), 1e-9)
    return np.asarray(height_m * LIMBS_PER_STATURE / size)


def smooth_over_time(values: np.ndarray, stamp_ns: np.ndarray, std_s: float) -> np.ndarray:
    """Gaussian average (F, ...) with a standard deviation in time."""
    from scipy.ndimage import gaussian_filter1d

    if len(values) < 2:
        return values
    step_s = float(np.median(np.diff(stamp_ns))) * 1e-9
    # The bound keeps invalid stamps (a counter for nanoseconds) from a kernel of 10^9 taps.
    frames = min(std_s / step_s, len(values), 1000.0)
    return np.asarray(gaussian_filter1d(values, frames, axis=0, mode="nearest", truncate=3.0))


@dataclass(frozen=True)
class WorldPoses:
    """Poses (F, 15, 3) m in the world, whether and from what their scale was measured, and the estimate."""

    joints: np.ndarray
    metric: bool
    scale_source: str
    scale: ScaleEstimate | None

    @property
    def factor(self) -> float:
        """Metres of the world over those of the assumed stature."""
        return self.scale.factor if self.metric and self.scale is not None else 1.0


def place_in_world(joints: np.ndarray, projected_px: np.ndarray, per_px: np.ndarray, camera: CameraPath) -> WorldPoses:
    """Poses (F, 15, 3) m in camera axes, pelvis at the origin, rotated and translated to the world (ENU, z up).

    The pelvis lies at the weak-perspective range, focal length times metres per px; every joint lies on the ray of
    its pixel (F, 15, 2) at the pose's depth.  This adds the perspective that the scaled orthographic model lacks.
    Without the camera's position the pelvis stays at the origin, without its matrix the perspective is unknown, too.
    Sufficient camera motion measures the scale.
    """
    to_world = camera.rotation
    assert to_world is not None
    k = camera.matrix
    if k is None:
        return WorldPoses(joints @ to_world, False, "assumed_height", None)
    range_m = 0.5 * (k[0, 0] + k[1, 1]) * per_px
    ray = np.concatenate(
        [(projected_px - k[:2, 2]) / np.diagonal(k)[:2], np.ones((*projected_px.shape[:2], 1))], axis=-1
    )
    # A joint nearer than a tenth of the range is an error of the pose.
    depth = np.maximum(range_m[:, None] + joints[..., 2], 0.1 * range_m[:, None])
    from_camera = (ray * depth[..., None]) @ to_world
    if camera.position is None:
        return WorldPoses(from_camera - from_camera[:, :1], False, "assumed_height", None)
    feet = from_camera[:, [BODY_15.index("lankle"), BODY_15.index("rankle")]]
    scale = estimate_scale(feet, camera.position, camera.stamp_ns)
    trusted = scale is not None and scale.trusted
    factor = scale.factor if scale is not None and trusted else 1.0
    placed = camera.position[:, None] + factor * from_camera
    return WorldPoses(placed, trusted, "telemetry" if trusted else "assumed_height", scale)
