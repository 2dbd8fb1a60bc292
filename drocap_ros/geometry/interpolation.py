"""Poses interpolated in time."""

from __future__ import annotations

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, slerp


def fill_frames(stamp_ns: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Poses (F, P, 3) whose frames of NaN are interpolated in time from their neighbours.

    Raises
    ------
    InputError
        When no frame has a pose.
    """
    known = np.isfinite(joints).all(axis=(1, 2))
    if known.all():
        return joints
    if not known.any():
        raise InputError("initial_joints: expected a pose in at least one frame, got NaN in all; check the 2D joints")
    t = (stamp_ns - stamp_ns[0]).astype(np.float64)
    count = int(np.count_nonzero(known))
    before = np.clip(np.searchsorted(t[known], t, side="right") - 1, 0, count - 1)
    after = np.minimum(before + 1, count - 1)
    t0, t1 = t[known][before], t[known][after]
    s = np.clip((t - t0) / np.where(t1 > t0, t1 - t0, 1.0), 0.0, 1.0)
    # Body and orientation separately: joints moved along straight lines would shrink a turning body.
    shape, rotation = to_torso_frame(joints[known])
    q = quaternion_from_matrix(rotation)
    turned = matrix_from_quaternion(slerp(q[before], q[after], s))
    bent = (1.0 - s)[:, None, None] * shape[before] + s[:, None, None] * shape[after]
    return np.where(known[:, None, None], joints, bent @ np.swapaxes(turned, 1, 2))


def true_runs(flags: np.ndarray) -> np.ndarray:
    """(R, 2) first index and the one after the last of each run of true flags (N,)."""
    edges: np.ndarray = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)
