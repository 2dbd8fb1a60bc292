"""Runs a method on the frames that show the person, and interpolates the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.interpolation import fill_frames
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import ImagePoses, MethodInput
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, normalize_tracks


def run_method(name: str, data: MethodInput) -> ImagePoses:
    """Poses of all frames by one of :data:`~drocap_ros.reconstruction.methods.METHODS`."""
    normalize_tracks(data.keypoints)  # raises on input without a usable frame
    use = usable_frames(data.keypoints)
    if use.all():
        return _checked(name, data)
    return _spread(_checked(name, data.frames(use)), use, data.stamp_ns)


def _checked(name: str, data: MethodInput) -> ImagePoses:
    poses = METHODS[name].run(data)
    expected = (*data.keypoints.xy.shape[:2], 3)
    found = poses.joints_px.shape if isinstance(poses, ImagePoses) else type(poses).__name__
    if found != expected:
        raise InputError(f"method {name}: expected ImagePoses with joints_px {expected}, found {found}; correct it")
    return poses


def usable_frames(keypoints: Keypoints2D) -> np.ndarray:
    """(F,) bool, frames with at least :data:`~drocap_ros.reconstruction.paper.normalize.MIN_JOINTS` joints apart."""
    seen = keypoints.weights > 0.0
    low = np.where(seen[..., None], keypoints.xy, np.inf).min(axis=1)
    high = np.where(seen[..., None], keypoints.xy, -np.inf).max(axis=1)
    with np.errstate(invalid="ignore"):
        apart = (high - low).max(axis=1) > 1e-6 * (1.0 + np.abs(np.nan_to_num(keypoints.xy)).max())
    return np.asarray((np.sum(seen, axis=1) >= MIN_JOINTS) & apart)


def _spread(found: ImagePoses, use: np.ndarray, stamp_ns: np.ndarray) -> ImagePoses:
    """Poses of the frames in use, interpolated over all frames."""
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)

    def over_time(values: np.ndarray | None) -> np.ndarray | None:
        if values is None:
            return None
        columns = values.reshape(len(values), -1).T
        return np.stack([np.interp(t, t[use], column) for column in columns], axis=-1).reshape(-1, *values.shape[1:])

    joints = np.full((len(use), *found.joints_px.shape[1:]), np.nan)
    joints[use] = found.joints_px
    translation = over_time(found.translation_px)
    assert translation is not None
    return replace(
        found,
        joints_px=fill_frames(stamp_ns, joints),
        translation_px=translation,
        sigma_px=over_time(found.sigma_px),
        still=over_time(found.still),
    )
