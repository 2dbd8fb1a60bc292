"""Baseline MF+NNM: rotations by matrix factorization, shapes by nuclear norm minimization (Dai, Li and He 2012).

It needs no initial poses.  The original chooses the rank and the mirror image with the truth; here the candidate
closest to the dictionary's poses wins.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import to_torso_frame
from drocap_ros.geometry.rotations import complete_rotation
from drocap_ros.reconstruction.common.config import BundleAdjusterConfig
from drocap_ros.reconstruction.common.poses import Report
from drocap_ros.reconstruction.paper.bundle_adjustment import Objective, minimize
from drocap_ros.reconstruction.paper.dictionary import Dictionary, normalize_poses
from drocap_ros.reconstruction.paper.reprojection import Projection, frames_first, frames_last

#: Candidates of K in the rank 3K of the factorization.
BASIS_SHAPES = (2, 3)
#: Two orthographic images fix no rotation.
MIN_IMAGES = 3
#: Of depth: what a factorization leaves open.
MIRROR = np.array([1.0, 1.0, -1.0])


def factorize(
    w: np.ndarray,
    information: np.ndarray,
    dictionary: Dictionary,
    config: BundleAdjusterConfig,
) -> tuple[np.ndarray, Report]:
    """Poses of one window by MF+NNM.

    w, information : (F, P, 2) and (F, P, 3), normalized; missing joints are interpolated for the factorization
    returns : poses (F, P, 3) in camera axes, and what the solver did
    """
    if len(w) < MIN_IMAGES:
        raise InputError(
            f"mf-nnm: expected at least {MIN_IMAGES} images that show the subject, got {len(w)}; choose another method"
        )
    full = fill_joints(w, information[..., 0] > 0.0)
    full = full - full.mean(axis=1, keepdims=True)
    config = replace(config, gamma=0.0)
    found = []
    for basis_shapes in BASIS_SHAPES:
        rotation = rotations_by_factorization(full, basis_shapes)
        shape, report = minimize_nuclear_norm(w, information, rotation, config)
        poses = shape @ np.swapaxes(rotation, 1, 2)
        found += [(candidate, report) for candidate in (poses, poses * MIRROR)]
    return min(found, key=lambda one: _distance(one[0], dictionary))


def minimize_nuclear_norm(
    w: np.ndarray,
    information: np.ndarray,
    rotation: np.ndarray,
    config: BundleAdjusterConfig,
    *,
    initial: np.ndarray | None = None,
) -> tuple[np.ndarray, Report]:
    """Shapes (F, P, 3) in the common frame for known rotations (F, 3, 3), and what the solver did.

    Without ``initial`` the first shapes are the joints back-projected into the common frame without depth.
    """
    centred = w - w.mean(axis=1, keepdims=True)
    s = frames_last(centred @ rotation[:, :2] if initial is None else initial)
    fixed = _FixedCameras(Projection(w, information), np.ascontiguousarray(np.moveaxis(rotation, 0, -1)), config)
    s, history, stop = minimize(fixed, s)
    return frames_first(s), Report(len(history) - 1, stop, fixed.terms(s))


class _FixedCameras(Objective):
    """Equations (2) and (3) with fixed rotations."""

    def update_rotation(self, s: np.ndarray) -> None:
        """The rotations stay."""


def rotations_by_factorization(w: np.ndarray, basis_shapes: int) -> np.ndarray:
    """Camera rotations (F, 3, 3) of centred, complete tracks (F, P, 2), up to a common rotation and mirroring."""
    frames, p = w.shape[:2]
    stacked = np.swapaxes(w, 1, 2).reshape(2 * frames, p)
    u, sigma, _ = np.linalg.svd(stacked, full_matrices=False)
    rank = min(3 * basis_shapes, len(sigma), 2 * frames)
    motion = (u[:, :rank] * np.sqrt(sigma[:rank])).reshape(frames, 2, rank)
    upgrade = metric_upgrade(motion / np.sqrt(np.mean(motion**2)))
    rotation = complete_rotation(motion @ upgrade)
    return _continuous(rotation)


def metric_upgrade(motion: np.ndarray) -> np.ndarray:
    """Corrective matrix G (3K, 3): the rows of ``motion[t] @ G`` (F, 2, 3K) become orthogonal and of equal length.

    ``Q = G G^T`` is found by trace minimization over positive semidefinite matrices (Dai, Li and He 2012,
    section 4.2) with accelerated proximal gradient steps, cut to rank 3, and refined by Gauss-Newton steps on G.
    """
    a, b = motion[:, 0], motion[:, 1]
    rank = motion.shape[2]
    equal = a[:, :, None] * a[:, None, :] - b[:, :, None] * b[:, None, :]
    cross = a[:, :, None] * b[:, None, :]
    size = a[:, :, None] * a[:, None, :] + b[:, :, None] * b[:, None, :]
    rows = np.concatenate([equal, cross + np.swapaxes(cross, 1, 2)]).reshape(-1, rank * rank)
    rows = rows / np.sqrt(len(a))
    # One more row fixes the overall size: without it Q = 0 is a solution.
    rows = np.concatenate([rows, size.mean(axis=0).reshape(1, -1)])
    target = np.zeros(len(rows))
    target[-1] = 2.0
    gram, moment = rows.T @ rows, rows.T @ target
    step = 1.0 / np.linalg.norm(gram, 2)
    q = ahead = np.eye(rank) / rank
    t, trace_weight = 1.0, 1e-3
    # Proximal gradient steps of the metric upgrade, chosen by hand.
    for _ in range(300):
        slope = (gram @ ahead.ravel() - moment).reshape(rank, rank)
        values, vectors = np.linalg.eigh(_symmetric(ahead - step * slope))
        new = (vectors * np.maximum(values - step * trace_weight, 0.0)) @ vectors.T
        t_new = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        ahead = new + ((t - 1.0) / t_new) * (new - q)
        q, t = new, t_new
    values, vectors = np.linalg.eigh(_symmetric(q))
    g = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 1e-9))
    return _refine_upgrade(g, a, b)


def _refine_upgrade(g: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Gauss-Newton on ``|a G|^2 = |b G|^2``, ``a G G^T b = 0``, mean size 1; relative to each frame's size."""

    def residuals(g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = a @ g, b @ g
        size = np.sum(x * x + y * y, axis=1) + 0.05
        gap = np.concatenate([np.sum(x * x - y * y, axis=1) / size, 2.0 * np.sum(x * y, axis=1) / size])
        dx = 2.0 * (a[:, :, None] * x[:, None] - b[:, :, None] * y[:, None]) / size[:, None, None]
        dy = 2.0 * (a[:, :, None] * y[:, None] + b[:, :, None] * x[:, None]) / size[:, None, None]
        mean = np.mean(np.sum(x * x + y * y, axis=1)) - 2.0
        dm = np.mean(2.0 * (a[:, :, None] * x[:, None] + b[:, :, None] * y[:, None]), axis=0)
        weight = np.sqrt(len(a))
        return (
            np.concatenate([gap, [weight * mean]]),
            np.concatenate([dx, dy, weight * dm[None]]).reshape(2 * len(a) + 1, -1),
        )

    gap, jac = residuals(g)
    damping = 1e-2
    # Gauss-Newton steps of its refinement, chosen by hand.
    for _ in range(30):
        hessian = jac.T @ jac
        move = np.linalg.solve(
            hessian + damping * (np.trace(hessian) / len(hessian)) * np.eye(len(hessian)), jac.T @ gap
        )
        trial = g - move.reshape(g.shape)
        new_gap, new_jac = residuals(trial)
        if np.sum(new_gap**2) < np.sum(gap**2):
            g, gap, jac, damping = trial, new_gap, new_jac, 0.3 * damping
        else:
            damping *= 5.0
    return g


def _symmetric(m: np.ndarray) -> np.ndarray:
    mean: np.ndarray = 0.5 * (m + m.T)
    return mean


def _continuous(rotation: np.ndarray) -> np.ndarray:
    """Undo the sign ambiguity of each frame: R or its half turn about the optical axis, the closer to the neighbour."""
    half_turn = np.array([-1.0, -1.0, 1.0])[:, None]
    agrees = np.sum(rotation[1:] * rotation[:-1], axis=(1, 2)) >= np.sum(
        rotation[1:] * rotation[:-1] * half_turn, axis=(1, 2)
    )
    sign = np.concatenate([[1.0], np.cumprod(np.where(agrees, 1.0, -1.0))])
    return np.where(sign[:, None, None] > 0.0, rotation, rotation * half_turn)


def fill_joints(w: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Tracks (F, P, 2) with unseen joints interpolated in time; a joint never seen takes the frame's centre."""
    if seen.all():
        return w
    t, out = np.arange(len(w)), np.zeros_like(w)
    for joint in range(w.shape[1]):
        known = seen[:, joint]
        if known.any():
            for axis in range(2):
                out[:, joint, axis] = np.interp(t, t[known], w[known, joint, axis])
    return out


def _distance(poses: np.ndarray, dictionary: Dictionary) -> float:
    """Mean squared Mahalanobis distance of poses (F, P, 3) from the dictionary's poses."""
    shape, _ = to_torso_frame(poses)
    flat = (normalize_poses(shape) - dictionary.mean).reshape(len(poses), -1)
    coordinates = flat @ dictionary.components.reshape(len(dictionary.components), -1).T
    return float(np.mean((coordinates / np.maximum(dictionary.component_std, 1e-3)) ** 2))
