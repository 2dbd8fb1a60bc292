"""Runs a method on the frames that show the person, and interpolates the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.geometry.interpolation import fill_frames
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.common.poses import CameraPoses, MethodInput
from drocap_ros.reconstruction.methods import METHODS
from drocap_ros.reconstruction.paper.normalize import MIN_JOINTS, normalize_tracks


def run_method(name: str, data: MethodInput) -> CameraPoses:
    """Poses of all frames by one of :data:`~drocap_ros.reconstruction.methods.METHODS`.

    Raises
    ------
    InputError
        When the keypoints show no person.
    """
    normalize_tracks(data.keypoints)  # raises on input without a usable frame
    use = usable_frames(data.keypoints)
    if use.all():
        return METHODS[name].run(data)
    return _spread(METHODS[name].run(data.frames(use)), use, data.stamp_ns)


def usable_frames(keypoints: Keypoints2D) -> np.ndarray:
    """(F,) bool, frames with at least :data:`~drocap_ros.reconstruction.paper.normalize.MIN_JOINTS` joints apart."""
    seen = keypoints.weights > 0.0
    low = np.where(seen[..., None], keypoints.xy, np.inf).min(axis=1)
    high = np.where(seen[..., None], keypoints.xy, -np.inf).max(axis=1)
    with np.errstate(invalid="ignore"):
        apart = (high - low).max(axis=1) > 1e-6 * (1.0 + np.abs(np.nan_to_num(keypoints.xy)).max())
    return np.asarray((np.sum(seen, axis=1) >= MIN_JOINTS) & apart)


def _spread(found: CameraPoses, use: np.ndarray, stamp_ns: np.ndarray) -> CameraPoses:
    """Poses of the frames in use, interpolated over all frames."""
    joints = np.full((len(use), *found.joints_px.shape[1:]), np.nan)
    joints[use] = found.joints_px
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)
    translation = np.stack([np.interp(t, t[use], found.translation_px[:, i]) for i in range(2)], axis=-1)
    sigma = found.sigma_px
    if sigma is not None:
        flat = sigma.reshape(len(sigma), -1).T
        sigma = np.stack([np.interp(t, t[use], column) for column in flat], axis=-1).reshape(-1, *sigma.shape[1:])
    still = found.still
    if still is not None:
        still = np.stack([np.interp(t, t[use], column) for column in still.T], axis=-1)
    joints = fill_frames(stamp_ns, joints)
    return replace(found, joints_px=joints, translation_px=translation, sigma_px=sigma, still=still)
