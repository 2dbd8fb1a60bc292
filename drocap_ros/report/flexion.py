"""Flexion of knees, hips and elbows: a straight leg or arm has 0 degrees."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.skeleton import indices

#: Ends of the two segments of a joint; a hip's first segment is the trunk.
_SEGMENTS = {
    "knee": (("hip", "knee"), ("knee", "ankle")),
    "hip": (("neck", "pelvis"), ("hip", "knee")),
    "elbow": (("shoulder", "elbow"), ("elbow", "wrist")),
}
_MIDDLE = ("neck", "pelvis")


def flexion(joints: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """(F, 2) degrees of the right and the left knee, hip and elbow; NaN where a joint is.

    Parameters
    ----------
    joints : (F, P, 3), any unit and frame
    names : (P,) of the joints

    Raises
    ------
    InputError
        When a joint is missing.
    """
    out = {}
    for joint, ends in _SEGMENTS.items():
        sides = []
        for side in "rl":
            places = [indices(names, tuple(n if n in _MIDDLE else side + n for n in pair)) for pair in ends]
            upper, lower = (joints[:, b] - joints[:, a] for a, b in places)
            across = np.linalg.norm(np.cross(upper, lower), axis=-1)
            sides.append(np.degrees(np.arctan2(across, (upper * lower).sum(axis=-1))))
        out[joint] = np.stack(sides, axis=1)
    return out


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
