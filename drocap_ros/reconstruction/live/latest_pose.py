"""The newest pose at image rate: each image's initial pose with the bone lengths of the last adjusted window.

Only the lengths are taken over.  The newest poses of a window have no later images and err as much as initial poses,
and half a second on their errors differ.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.bones import bone_lengths
from drocap_ros.skeleton import BODY_17

_BONES = BODY_17.bones


def median_bone_lengths(joints: np.ndarray) -> np.ndarray:
    """Median length (16,) of each bone over the poses (F, 17, 3) of a window."""
    lengths: np.ndarray = np.median(bone_lengths(joints), axis=0)
    return lengths


class LatestPose:
    """Poses with the bone lengths of the last solution, blended in linearly within ``blend_s`` of stamps.

    From one image to the next, ``dt`` later, a new solution changes the length of a bone by no more than
    ``dt / blend_s`` of the difference between the solutions, and moves a joint by no more than the sum of that over
    the bones from the pelvis to it.  Before the first solution poses stay unchanged; it is blended in as well.
    """

    def __init__(self, blend_s: float) -> None:
        self._blend_ns = round(blend_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._from: np.ndarray | None = None
        self._to: np.ndarray | None = None
        self._begin_ns = 0

    @property
    def corrected(self) -> bool:
        """Whether a solution has arrived."""
        return self._to is not None

    def set_solution(self, lengths: np.ndarray, stamp_ns: int) -> None:
        """Blend in a solution's bone lengths (16,) m from the image of ``stamp_ns`` on."""
        if not np.isfinite(lengths).all():
            return
        self._from = self._lengths(stamp_ns)
        self._to, self._begin_ns = lengths, stamp_ns

    def pose(self, stamp_ns: int, joints: np.ndarray) -> np.ndarray:
        """Joints (P, 3) m in camera axes, pelvis at the origin, from the image's initial ones; NaN stays NaN."""
        lengths = self._lengths(stamp_ns)
        if lengths is None or not np.isfinite(joints).all():
            return joints
        rigid = _with_lengths(joints, lengths)
        if self._from is not None:
            return rigid
        share = self._share(stamp_ns)
        return (1.0 - share) * joints + share * rigid

    def _lengths(self, stamp_ns: int) -> np.ndarray | None:
        if self._to is None or self._from is None:
            return self._to
        share = self._share(stamp_ns)
        return (1.0 - share) * self._from + share * self._to

    def _share(self, stamp_ns: int) -> float:
        if self._blend_ns == 0:
            return 1.0
        return min(max((stamp_ns - self._begin_ns) / self._blend_ns, 0.0), 1.0)


def _with_lengths(joints: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Joints (P, 3) whose bones keep their directions and have these lengths, where given; pelvis at the origin."""
    bones = _BONES[: len(joints) - 1]
    way = joints[bones[:, 1]] - joints[bones[:, 0]]
    known = way[: len(lengths)]
    known *= (lengths[: len(known)] / np.maximum(np.linalg.norm(known, axis=-1), 1e-9))[:, None]
    out = np.zeros_like(joints)
    for bone, (parent, child) in enumerate(bones):
        out[child] = out[parent] + way[bone]
    return out
