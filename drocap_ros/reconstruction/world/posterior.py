"""Posterior covariances of body and cameras in the world, from the equations at the solution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drocap_ros.reconstruction.common.engine import Covariances, Equations
from drocap_ros.reconstruction.world.world_model import JOINTS, SCALE, WorldState


class Posterior(NamedTuple):
    """Covariances at a unit variance of every residual.

    place : (3, 3) m^2 of the mean place of all joints of all frames, in the world
    joints : (F, 17, 3, 3) m^2 about it; shared : of the shared unknowns
    """

    place: np.ndarray
    joints: np.ndarray
    shared: np.ndarray


def posterior(equations: Equations, state: WorldState) -> Posterior | None:
    """Covariances from the equations at the solution; None = not positive definite."""
    found = Covariances.of(equations)
    if found is None:
        return None
    frames, scale, size = len(state.joints), float(state.globals[SCALE]), len(found.shared)
    cameras = state.camera.shape[1]
    lever = found.lever.reshape(frames, -1, size)[:, cameras:].reshape(frames, JOINTS, 3, -1) / scale
    lever[..., SCALE] += state.joints / scale**2
    joints = np.empty((frames, JOINTS, 3, 3))
    blocks, _ = found.blocks(cameras + 3 * JOINTS, np.float32)
    for joint in range(JOINTS):
        at = slice(cameras + 3 * joint, cameras + 3 * joint + 3)
        joints[:, joint] = blocks[:, at, at] / scale**2
    weighted = (lever.reshape(-1, size) @ found.shared).reshape(lever.shape)
    joints += weighted @ np.swapaxes(lever, -1, -2)
    # Of the joints with their mean place.
    mean = np.zeros((frames, cameras + 3 * JOINTS, 3))
    mean[:, cameras:] = np.tile(np.eye(3), (JOINTS, 1)) / (frames * JOINTS * scale)
    own = found.of_frames(mean.reshape(-1, 3)).reshape(mean.shape)[:, cameras:] / scale
    with_place = own.reshape(frames, JOINTS, 3, 3) + lever @ (found.shared @ lever.mean(axis=(0, 1)).T)
    place = with_place.mean(axis=(0, 1))
    return Posterior(place, joints - with_place - np.swapaxes(with_place, -1, -2) + place, found.shared)
