"""Centring and scaling of 2D tracks: the solvers work on centred joints of unit standard deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.keypoints import Keypoints2D
from drocap_ros.reconstruction.paper.reprojection import information_from

#: Fewer joints in every image determine no pose, and fewer rays no place in the world.
MIN_JOINTS = 4


@dataclass(frozen=True)
class NormalizedTracks:
    """Tracks in the solvers' units: ``px = w * scale_px + centre_px``.

    w : (F, P, 2), 0 where not seen
    information : (F, P, 3) xx, xy, yy weight of each joint in the reprojection term; 1, 0, 1 is an ordinary joint
    centre_px : (F, 2)
    scale_px : px per unit; the standard deviation of all centred coordinates of seen joints
    """

    w: np.ndarray
    information: np.ndarray
    centre_px: np.ndarray
    scale_px: float

    def in_px(self, poses: np.ndarray) -> np.ndarray:
        """Poses (F, P, 3) of the solvers' units in px, x and y in the image."""
        joints = poses * self.scale_px
        joints[..., :2] += self.centre_px[:, None]
        return joints


def normalize_tracks(keypoints: Keypoints2D) -> NormalizedTracks:
    """Centre each image's seen joints and scale the sequence to unit standard deviation.

    keypoints : px; confidences of NaN and 0 count as not seen; covariances of seen joints must be positive definite
    """
    weights = keypoints.seen.astype(np.float64)
    if keypoints.confidence is not None:
        weights = weights * _checked_confidence(keypoints.confidence)
    seen = weights > 0.0
    if seen.sum(1).max(initial=0) < MIN_JOINTS:
        raise InputError(
            f"keypoints: expected an image with at least {MIN_JOINTS} seen joints, got at most"
            f" {seen.sum(1).max(initial=0)}; check the 2D tracks"
        )
    points = np.where(seen[..., None], keypoints.xy, 0.0)
    count = np.sum(seen, axis=1)
    centre = points.sum(1) / np.maximum(count, 1)[:, None]
    w = np.where(seen[..., None], points - centre[:, None], 0.0)
    scale_px = float(np.sqrt(np.sum(w * w) / (2.0 * count.sum())))
    if not scale_px > 1e-6 * (1.0 + np.abs(points).max()):
        raise InputError("keypoints: expected joints apart from each other, got all in one point; check the 2D tracks")
    covariance = keypoints.covariance
    if covariance is not None:
        _check_covariance(covariance, seen)
    w = w / scale_px
    units = None if covariance is None else covariance / scale_px**2
    information = information_from(np.where(seen[..., None], w, np.nan), weights, units)
    return NormalizedTracks(w, information, _filled(centre, count > 0), scale_px)


def check_uncertainty(keypoints: Keypoints2D, seen: np.ndarray) -> None:
    """Check confidence and covariance as :func:`normalize_tracks` does; ``seen`` (F, P) bool."""
    if keypoints.confidence is not None:
        _checked_confidence(keypoints.confidence)
    if keypoints.covariance is not None:
        _check_covariance(keypoints.covariance, seen)


def _checked_confidence(confidence: np.ndarray) -> np.ndarray:
    """The confidence with 0 for NaN."""
    c = np.where(np.isfinite(confidence), confidence, 0.0)
    if c.min(initial=0.0) < 0.0 or c.max(initial=0.0) > 1.0 + 1e-6:
        raise InputError(f"confidence: expected values in [0, 1], got {c.min():g} to {c.max():g}; rescale them")
    return c


def _check_covariance(covariance: np.ndarray, seen: np.ndarray) -> None:
    xx, xy, yy = np.moveaxis(np.asarray(covariance, dtype=np.float64), -1, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        good = np.isfinite(covariance).all(-1) & (xx > 0) & (yy > 0) & (xx * yy - xy * xy > 0)
    if (seen & ~good).any():
        f, p = np.argwhere(seen & ~good)[0]
        raise InputError(
            f"covariance: expected finite, positive definite px^2 where a joint is seen, got"
            f" {np.asarray(covariance)[f, p].tolist()} at frame {f} joint {p}; drop the covariance or the joint"
        )


def _filled(centre: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Centres of images without a joint, interpolated from their neighbours."""
    if known.all():
        return centre
    t = np.arange(len(centre))
    return np.stack([np.interp(t, t[known], centre[known, i]) for i in range(2)], axis=-1)
