"""A 3D pose of every image by another method, as evidence of depth: it decides signs and supports the depth prior.

Single pictures show which end of a bone is nearer where keypoints do not.  Such an estimate errs by more than the
keypoints do: places across the image stay theirs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drocap_ros.skeleton import BODY_17

#: Least standard deviation of a joint's depth in the evidence, mm of an ordinary person: of the best single-image
#: methods on their own test sets, per joint.
_LEAST_MM = 30.0
#: Errors in depth over those across the image, which can be measured: of BlazePose on three videos with optical MoCap.
_DEEPER = 1.5
#: Most frames with evidence may lack a bone; one of them is enough for the scale.
_LEAST_LENGTH = 1e-9


@dataclass(frozen=True)
class Evidence:
    """Poses in the axes of each image's camera, any unit and place.

    joints : (F, P, 3) of a body set, NaN where unknown
    sigma : (F, P) expected error in the same unit, NaN where unknown
    """

    joints: np.ndarray
    sigma: np.ndarray

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Evidence:
        """The evidence with the same change along the frames of both arrays."""
        return Evidence(change(self.joints), change(self.sigma))

    def turned(self, turn: np.ndarray) -> Evidence:
        """The evidence in axes turned by (F, 3, 3)."""
        return Evidence(self.joints @ np.swapaxes(turn, 1, 2), self.sigma)

    def depths(self, pose_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(F, P) mm behind the pelvis and (F, P) their standard deviations, NaN and infinite where unknown.

        The scale is that of the bones; the errors are at least those across the image from ``pose_mm`` (F, P, 3).
        """
        parent, child = BODY_17.bones[: pose_mm.shape[1] - 1].T
        about = self.joints - self.joints[:, :1]
        theirs = np.linalg.norm(about[:, child] - about[:, parent], axis=-1)
        ours = np.linalg.norm(pose_mm[:, child] - pose_mm[:, parent], axis=-1)
        known = np.isfinite(theirs) & (theirs > _LEAST_LENGTH)
        if not known.any():
            return np.full(pose_mm.shape[:2], np.nan), np.full(pose_mm.shape[:2], np.inf)
        about = about * float(np.median(ours[known]) / np.median(theirs[known]))
        scale = float(np.median(ours[known]) / np.median(theirs[known]))
        gap = about[..., :2] - (pose_mm - pose_mm[:, :1])[..., :2]
        count = np.maximum(np.isfinite(gap[..., 0]).sum(axis=0), 1)
        across = np.sqrt(np.nansum(np.square(gap), axis=(0, 2)) / (2 * count))
        sigma = np.fmax(np.fmax(self.sigma * scale, _DEEPER * across), _LEAST_MM)
        return about[..., 2], np.where(np.isfinite(about[..., 2]), sigma, np.inf)
