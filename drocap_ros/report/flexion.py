"""Flexion of knees, hips and elbows: a straight leg or arm has 0 degrees; a thigh behind the trunk less."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import indices

#: The three joints of an angle.
_CHAINS = {"knee": ("hip", "knee", "ankle"), "elbow": ("shoulder", "elbow", "wrist")}


def flexion(joints: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """(F, 2) degrees of the right and the left knee, hip and elbow; NaN where a joint is.

    Parameters
    ----------
    joints : (F, P, 3), any unit and frame
    names : (P,) of the joints
    """
    at = dict(zip(names, np.moveaxis(joints, 1, 0), strict=True))
    indices(names, ("neck", "pelvis", *(side + name for side in "rl" for name in ("hip", *sum(_CHAINS.values(), ())))))
    return {"knee": _bend(at, "knee"), "hip": _hips(at), "elbow": _bend(at, "elbow")}


def _bend(at: dict[str, np.ndarray], joint: str) -> np.ndarray:
    sides = []
    for side in "rl":
        first, middle, last = (at[side + name] for name in _CHAINS[joint])
        upper, lower = middle - first, last - middle
        across = np.linalg.norm(np.cross(upper, lower), axis=-1)
        sides.append(np.degrees(np.arctan2(across, (upper * lower).sum(axis=-1))))
    return np.stack(sides, axis=1)


def _hips(at: dict[str, np.ndarray]) -> np.ndarray:
    """Between trunk and thigh, seen from the side: forwards is positive."""
    trunk = at["neck"] - at["pelvis"]
    forwards = np.cross(at["lhip"] - at["rhip"], trunk)
    up = np.cross(forwards, at["lhip"] - at["rhip"])
    scale = np.linalg.norm(up, axis=-1) / np.maximum(np.linalg.norm(forwards, axis=-1), 1e-12)
    sides = []
    for side in "rl":
        thigh = at[side + "knee"] - at[side + "hip"]
        ahead = (thigh * forwards).sum(axis=-1) * scale
        # No thigh points backwards by a right angle: the cut lies there.
        sides.append(np.degrees((np.arctan2(ahead, -(thigh * up).sum(axis=-1)) + 0.5 * np.pi) % (2 * np.pi)) - 90.0)
    return np.stack(sides, axis=1)


def flexion_words(joints: np.ndarray, names: tuple[str, ...]) -> str:
    """Medians over the frames, right and left, in words; empty without the joints' names or values."""
    try:
        angles = flexion(joints, names)
    except InputError:
        return ""
    known = {joint: angle[np.isfinite(angle).all(axis=1)] for joint, angle in angles.items()}
    if not all(len(angle) for angle in known.values()):
        return ""
    medians = {joint: np.median(angle, axis=0) for joint, angle in known.items()}
    return ", ".join(f"{joint}s {both[0]:.0f} and {both[1]:.0f}" for joint, both in medians.items()) + " degrees"
