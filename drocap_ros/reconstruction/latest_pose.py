"""The newest pose at image rate: each image's initial pose, corrected by what the last adjustment found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.skeleton import BODY_15

_BONES = BODY_15.bones

#: The offset is the mean over this end of a window: what the initial poses err in the same way for that long.
OFFSET_S = 1.5

#: While no new solution comes, the offset is held so long behind its window, then fades out.
HOLD_S, FADE_S = 3.0, 2.0


@dataclass(frozen=True)
class Correction:
    """What a solution says of the initial poses.

    lengths : (14,) m, of the bones (joint j to its parent at j - 1)
    offset : (15, 3) m, torso frame, refined less initial pose
    stamp_ns : the window's newest image
    """

    lengths: np.ndarray
    offset: np.ndarray
    stamp_ns: int

    @staticmethod
    def of(stamp_ns: np.ndarray, refined: np.ndarray, initial: np.ndarray) -> Correction | None:
        """From a window: stamps (F,), refined and initial joints (F, 15, 3) m; None where no pose is known."""
        lengths = np.median(_lengths(refined), axis=0)
        end = stamp_ns >= stamp_ns[-1] - round(OFFSET_S * 1e9)
        end &= np.isfinite(refined).all(axis=(1, 2)) & np.isfinite(initial).all(axis=(1, 2))
        if not end.any() or not np.isfinite(lengths).all():
            return None
        shape, _ = to_torso_frame(refined[end])
        start, _ = to_torso_frame(initial[end])
        return Correction(lengths, np.mean(shape - start, axis=0), int(stamp_ns[-1]))


class LatestPose:
    """Applies the last correction, and takes a new one over within ``blend_s`` of stamps.

    The lengths and the offset in use move along a straight line from what they are when a solution comes to the new
    ones: from one image to the next, ``dt`` later, a solution changes them by no more than ``dt / blend_s`` of the
    difference, and the joints with them.  Before the first solution poses pass unchanged; it is blended in likewise.
    """

    def __init__(self, blend_s: float) -> None:
        self._blend_ns = round(blend_s * 1e9)
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._from: Correction | None = None
        self._to: Correction | None = None
        self._begin_ns = 0

    @property
    def corrected(self) -> bool:
        """Whether a solution has come."""
        return self._to is not None

    def solved(self, correction: Correction, stamp_ns: int) -> None:
        """Take over a solution; stamp_ns : of the image published last."""
        self._from = self._at(stamp_ns)
        self._to, self._begin_ns = correction, stamp_ns

    def pose(self, stamp_ns: int, joints: np.ndarray) -> np.ndarray:
        """Corrected joints (15, 3) m in camera axes, pelvis at the origin, of an initial pose; NaN stays NaN."""
        now = self._at(stamp_ns)
        if now is None or not np.isfinite(joints).all():
            return joints
        shape, rotation = to_torso_frame(joints)
        age_s = (stamp_ns - now.stamp_ns) * 1e-9
        held = float(np.clip((HOLD_S + FADE_S - age_s) / FADE_S, 0.0, 1.0))
        corrected = _with_lengths((shape + held * now.offset) @ rotation.T, now.lengths)
        share = 1.0 if self._from is not None else self._share(stamp_ns)
        return (1.0 - share) * joints + share * corrected

    def _at(self, stamp_ns: int) -> Correction | None:
        """The correction in use."""
        if self._to is None or self._from is None:
            return self._to
        share = self._share(stamp_ns)
        return Correction(
            (1.0 - share) * self._from.lengths + share * self._to.lengths,
            (1.0 - share) * self._from.offset + share * self._to.offset,
            self._to.stamp_ns,
        )

    def _share(self, stamp_ns: int) -> float:
        return 1.0 if self._blend_ns == 0 else min(max((stamp_ns - self._begin_ns) / self._blend_ns, 0.0), 1.0)


def _lengths(joints: np.ndarray) -> np.ndarray:
    return np.linalg.norm(joints[..., _BONES[:, 1], :] - joints[..., _BONES[:, 0], :], axis=-1)


def _with_lengths(joints: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Joints (15, 3) whose bones keep their direction and have these lengths (14,); pelvis at the origin."""
    way = joints[_BONES[:, 1]] - joints[_BONES[:, 0]]
    way *= (lengths / np.maximum(np.linalg.norm(way, axis=-1), 1e-9))[:, None]
    out = np.zeros_like(joints)
    for bone, (parent, child) in enumerate(_BONES):
        out[child] = out[parent] + way[bone]
    return out
