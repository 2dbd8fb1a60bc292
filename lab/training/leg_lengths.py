"""Legs of MoCap refitted to a person who can stand straight: hips and ankles stay, thighs and shanks become shorter.

MoCap skeletons were fitted with legs 1 to 2 % too long, so that people who stand straight have bent knees.  Seen from
the front a straight leg and a bent one differ by that alone.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.skeleton import BODY_15, indices

_LEGS = np.stack([indices(BODY_15.joints, (s + "hip", s + "knee", s + "ankle")) for s in "rl"])
#: Share of a sequence's frames in which a leg may reach farther than its refitted bones: they are noise.
_REACHING = 0.01


def _leg(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(..., 2) distance of hip and ankle, length of the thigh and of the shank."""
    hip, knee, ankle = (joints[..., _LEGS[:, k], :] for k in range(3))
    distance, thigh, shank = (np.linalg.norm(b - a, axis=-1) for a, b in ((hip, ankle), (hip, knee), (knee, ankle)))
    return distance, thigh, shank


def leg_reach(joints: np.ndarray) -> float:
    """Longest distance of hip and ankle over the length of thigh and shank, in a sequence (F, P, 3)."""
    distance, thigh, shank = _leg(joints)
    return float(np.quantile(distance / (thigh + shank), 1.0 - _REACHING))


def shortening(motion: np.ndarray, reach: np.ndarray, least_flexion: np.ndarray) -> np.ndarray:
    """(B,) factor of the legs' bones, at most 1, by which the least flexion of a sequence becomes ``least_flexion``.

    Parameters
    ----------
    motion : (B, F, P, 3) windows of the sequences
    reach : (B,) :func:`leg_reach` of the sequences
    least_flexion : (B,) rad, of the knees
    """
    _, thigh, shank = _leg(motion)
    ratio = np.median(thigh / (thigh + shank), axis=(1, 2))
    longest = np.sqrt(ratio**2 + (1 - ratio) ** 2 + 2 * ratio * (1 - ratio) * np.cos(least_flexion))
    factor: np.ndarray = np.minimum(reach / longest, 1.0)
    return factor


def refit_knees(motion: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Windows (B, F, P, 3) whose thighs and shanks have ``factor`` (B,) of their length: the knees move alone."""
    hip, knee, ankle = (motion[..., _LEGS[:, k], :] for k in range(3))
    distance, thigh, shank = _leg(motion)
    thigh, shank = thigh * factor[:, None, None], shank * factor[:, None, None]
    along = (ankle - hip) / np.maximum(distance, 1e-6)[..., None]
    place = (distance**2 + thigh**2 - shank**2) / np.maximum(2 * distance, 1e-6)
    # A leg that reaches farther than its bones is straight.
    place = np.where(distance < thigh + shank, place, distance * thigh / (thigh + shank))
    aside = (knee - hip) - ((knee - hip) * along).sum(axis=-1, keepdims=True) * along
    aside /= np.linalg.norm(aside, axis=-1, keepdims=True) + 1e-6
    height = np.sqrt(np.maximum(thigh**2 - place**2, 0.0))
    out = motion.copy()
    out[..., _LEGS[:, 1], :] = hip + place[..., None] * along + height[..., None] * aside
    return out
