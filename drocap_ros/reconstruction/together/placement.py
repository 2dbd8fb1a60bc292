"""Place of one view's world in another's: by the body that both show, at equal times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.bones import limb_lengths
from drocap_ros.geometry.rotations import project_to_so3
from drocap_ros.reconstruction.together.view import View

#: Distance (m) of a joint about the pelvis at which it counts half: signs of depth are wrong in every sixth limb.
_HALF_M = 0.1
#: Rounds of the robust fit, each from the weights of the one before.
_ROUNDS = 15
#: Times (1/s) at which bodies are compared.
_RATE_HZ = 10.0


class Placement(NamedTuple):
    """``place in the first's world = scale * rotation @ place in the second's + translation``.

    residual_m : robust distance of the joints about the pelvis
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    residual_m: float


def place_view(first: View, second: View, offset_s: float, upright: bool) -> Placement:
    """Where the second view's world lies in the first's.

    Parameters
    ----------
    offset_s : time of the first less that of the second
    upright : both worlds know up, so they differ by a turn about it
    """
    time = _common_times(first, second, offset_s)
    a, b = first.joints_at(time), second.joints_at(time - offset_s)
    scale = float(np.median(limb_lengths(a).sum(-1)) / np.median(limb_lengths(b).sum(-1)))
    about_a, about_b = a - a[:, :1], scale * (b - b[:, :1])
    rotation, residual = _turn(about_a.reshape(-1, 3), about_b.reshape(-1, 3), upright)
    translation = np.median(a[:, 0] - scale * b[:, 0] @ rotation.T, axis=0)
    return Placement(scale, rotation, translation, residual)


def _common_times(first: View, second: View, offset_s: float) -> np.ndarray:
    a, b = first.time_s, second.time_s + offset_s
    return np.arange(max(a[0], b[0]), min(a[-1], b[-1]), 1.0 / _RATE_HZ)


def _turn(a: np.ndarray, b: np.ndarray, upright: bool) -> tuple[np.ndarray, float]:
    """Rotation (3, 3) that takes points b (N, 3) to a, robust, and the median distance."""
    weight = np.ones(len(a))
    rotation, distance = np.eye(3), np.zeros(len(a))
    for _ in range(_ROUNDS):
        cross = a.T @ (weight[:, None] * b)
        if upright:
            angle = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
            cos, sin = np.cos(angle), np.sin(angle)
            rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        else:
            rotation = project_to_so3(cross)
        distance = np.linalg.norm(a - b @ rotation.T, axis=1)
        weight = 1.0 / np.square(1.0 + np.square(distance / _HALF_M))
    return rotation, float(np.median(distance))
