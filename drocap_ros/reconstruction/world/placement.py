"""Scale and placement of the reconstructed body: px to metres, camera to world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.camera_path import CameraPath
from drocap_ros.contacts import rest_likelihood
from drocap_ros.geometry.alignment import LIMBS_PER_STATURE, limb_lengths
from drocap_ros.reconstruction.world.world_model import MEASURED
from drocap_ros.skeleton import BODY_15

#: Times (s) between two positions of a foot: parts of the half second for which a walker's foot stands.
LAGS_S = (0.15, 0.25, 0.4)

#: Standard deviation (m) of the way of a foot at rest across the line of sight: errors of adjusted poses.
STILL_M = 0.03

#: Least factor: a person of 1.02 m at the usual assumed stature of 1.70 m;
LOWEST = 0.6
#: and the greatest one, beyond all people.
HIGHEST = 1.6

#: Most pairs of frames, spread over the recording: more take time and tell the same.
MOST_PAIRS = 4000


@dataclass(frozen=True)
class ScaleEstimate:
    """Factor on the assumed scale, its relative standard deviation, and the share of still feet, 0 = by other means."""

    factor: float
    std: float
    support: float = 0.0

    @property
    def trusted(self) -> bool:
        """Whether camera and feet determine the scale: to 3 %, by a fifth of the pairs, within the range."""
        return self.std < MEASURED and self.support > 0.2 and LOWEST * 1.02 < self.factor < HIGHEST / 1.02


def estimate_scale(feet: np.ndarray, camera_position: np.ndarray, stamp_ns: np.ndarray) -> ScaleEstimate | None:
    """Scale at which the feet are still.

    feet : (F, N, 3) m at the assumed scale, camera to foot, world axes
    camera_position : (F, 3) m, world axes
    stamp_ns : (F,)
    returns : ScaleEstimate, or None when the camera moves too little or there are too few frames
    """
    gap, base = _pairs(feet, camera_position, stamp_ns)
    # Camera motion below a foot's uncertainty carries no information.
    moved = np.linalg.norm(base, axis=1) > 5.0 * STILL_M
    gap, base = gap[moved], base[moved]
    if len(gap) < 50:
        return None
    # |base + factor * gap|^2 for all factors at once.
    a, b, c = (np.sum(x * y, axis=1) for x, y in ((gap, gap), (gap, base), (base, base)))
    factors = np.geomspace(LOWEST, HIGHEST, 200)
    square = np.maximum(a[:, None] * factors**2 + 2.0 * b[:, None] * factors + c[:, None], 0.0)
    score = rest_likelihood(square, STILL_M).sum(0)
    factor = float(factors[np.argmax(score)])
    for _ in range(10):
        weight = rest_likelihood(np.maximum(a * factor**2 + 2.0 * b * factor + c, 0.0), STILL_M)
        if weight.sum() < 1e-9:
            return None
        factor = float(np.clip(-np.sum(weight * b) / np.sum(weight * a), LOWEST, HIGHEST))
    support = float(weight.mean())
    # Neighbouring pairs share their frames: a tenth of them is independent.
    independent = max(support * len(gap) / 10.0, 1.0)
    spread = np.sqrt(np.sum(weight * (a * factor**2 + 2.0 * b * factor + c)) / weight.sum() / 2.0)
    lever = np.sqrt(np.sum(weight * a) / weight.sum())
    return ScaleEstimate(factor, float(spread / (lever * factor * np.sqrt(independent))), support)


def _pairs(feet: np.ndarray, camera: np.ndarray, stamp_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Changes (M, 3) of camera-to-foot vectors and of the camera over the lags, across the line of sight."""
    gaps: list[np.ndarray] = []
    bases: list[np.ndarray] = []
    for lag_s in LAGS_S:
        later = np.searchsorted(stamp_ns, stamp_ns + round(lag_s * 1e9))
        first = np.flatnonzero(later < len(stamp_ns))
        # Pairs across a gap of the recording are left out.
        first = first[(stamp_ns[later[first]] - stamp_ns[first]) < 1.5e9 * lag_s]
        stride = max(1, len(first) * feet.shape[1] * len(LAGS_S) // MOST_PAIRS)
        first = first[::stride]
        second = later[first]
        sight = feet[first] + feet[second]
        sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
        for out, change in (
            (gaps, feet[second] - feet[first]),
            (bases, np.broadcast_to((camera[second] - camera[first])[:, None], feet[first].shape)),
        ):
            out.append((change - np.sum(change * sight, axis=-1, keepdims=True) * sight).reshape(-1, 3))
    return np.concatenate(gaps), np.concatenate(bases)


def metres_per_px(joints_px: np.ndarray, stamp_ns: np.ndarray, height_m: float) -> np.ndarray:
    """(F,) metres per px that give the body of poses (F, 15, 3) px the limb lengths of a person of ``height_m``."""
    total = limb_lengths(joints_px).sum(-1)
    # Standard deviation (s) of the average of the person's image size: a drone changes its range slowly.
    size = np.maximum(smooth_over_time(total, stamp_ns, 1.0), 1e-9)
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
