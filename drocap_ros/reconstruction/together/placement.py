"""Place of one view's world in another's: by the body that both show, at equal times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from drocap_ros.geometry.alignment import limb_lengths
from drocap_ros.geometry.rotations import exp_so3, project_to_so3
from drocap_ros.reconstruction.together.view import View

#: Times (1/s) at which bodies are compared.
_RATE_HZ = 10.0
#: Standard deviations (s) of the averages of a camera's turn and place beside a body: a drone turns by 10 degrees in
#: half a second, and its place needs the range, which errs for longer.
_TURN_S, _PLACE_S = 0.5, 1.0


class Placement(NamedTuple):
    """``place in the first's world = scale * rotation @ place in the second's + translation``.

    rotation, translation : (3, 3), (3,) m; of a camera that moves (F, 3, 3), (F, 3) at the images of the second
    residual_m : robust distance of the joints about the pelvis
    """

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    residual_m: float

    @property
    def moves(self) -> bool:
        """Whether one camera moves in the other's world."""
        if self.rotation.ndim == 2:
            return False
        turn = self.rotation @ project_to_so3(self.rotation.sum(axis=0)).T
        angle = np.arccos(np.clip(0.5 * (np.trace(turn, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
        # Beside cameras that stand, signs of depth that are wrong for a second turn a body by 5 degrees.
        return bool(np.percentile(np.degrees(angle), 90) > 15.0)


def place_view(first: View, second: View, offset_s: float, upright: bool) -> Placement:
    """Where the second view's world lies in the first's.

    offset_s : time of the first less that of the second
    upright : both worlds know up, so they differ by a turn about it
    """
    _, a, b, scale = _bodies(first, second, offset_s)
    about_a, about_b = a - a[:, :1], scale * (b - b[:, :1])
    rotation, residual = _turn(about_a.reshape(1, -1, 3), about_b.reshape(1, -1, 3), upright)
    translation = np.median(a[:, 0] - scale * b[:, 0] @ rotation[0].T, axis=0)
    return Placement(scale, rotation[0], translation, residual)


def follow_view(first: View, second: View, offset_s: float) -> Placement:
    """Where the second view's camera, of which nothing is known, moves in the first's world; parameters as above.

    Its own world is at rest in the camera.  Before and after the first view's images it stays where it was.
    """
    time, a, b, scale = _bodies(first, second, offset_s)
    rotation, residual = _turn(a - a[:, :1], scale * (b - b[:, :1]), upright=False)
    translation = a[:, 0] - scale * (rotation @ b[:, 0, :, None])[..., 0]
    translation = gaussian_filter1d(translation, _PLACE_S * _RATE_HZ, axis=0, mode="nearest")
    own = second.time_s + offset_s
    found = np.concatenate([rotation.reshape(-1, 9), translation], axis=1)
    found = np.stack([np.interp(own, time, column) for column in found.T], axis=1)
    return Placement(scale, project_to_so3(found[:, :9].reshape(-1, 3, 3)), found[:, 9:], residual)


def _bodies(first: View, second: View, offset_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Common times (S,) s, both bodies (S, 17, 3) m there, and the size of the first one over that of the second."""
    own, other = first.time_s, second.time_s + offset_s
    time = np.arange(max(own[0], other[0]), min(own[-1], other[-1]), 1.0 / _RATE_HZ)
    a, b = first.joints_at(time), second.joints_at(time - offset_s)
    return time, a, b, float(np.median(limb_lengths(a).sum(-1)) / np.median(limb_lengths(b).sum(-1)))


def _turn(a: np.ndarray, b: np.ndarray, upright: bool) -> tuple[np.ndarray, float]:
    """Rotations (S, 3, 3) that take points b (S, N, 3) to a at so many instants, robust, and the median distance."""
    weight = np.ones(a.shape[:2])
    rotation, distance = np.eye(3), np.zeros(a.shape[:2])
    # Rounds of the robust fit, each from the weights of the one before.
    for _ in range(15):
        cross = np.swapaxes(a, 1, 2) @ (weight[..., None] * b)
        if len(cross) > 1:
            cross = gaussian_filter1d(cross, _TURN_S * _RATE_HZ, axis=0, mode="nearest")
        if upright:
            angle = np.arctan2(cross[:, 1, 0] - cross[:, 0, 1], cross[:, 0, 0] + cross[:, 1, 1])
            rotation = exp_so3(angle[:, None] * [0.0, 0.0, 1.0])
        else:
            rotation = project_to_so3(cross)
        distance = np.linalg.norm(a - b @ np.swapaxes(rotation, 1, 2), axis=-1)
        # Distance (m) of a joint about the pelvis at which it counts half: signs of depth are wrong in every sixth
        # limb.
        weight = 1.0 / np.square(1.0 + np.square(distance / 0.1))
    return rotation, float(np.median(distance))
