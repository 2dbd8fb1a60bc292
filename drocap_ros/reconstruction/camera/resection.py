"""The pose of one keyframe by points whose places are known."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.rotations import exp_so3

#: Distance (px) of a point from its projection within which it agrees with a pose.
AGREES_PX = 4.0
#: Points that agree, at least, and share of them.
LEAST_POINTS = 10
_LEAST_SHARE = 0.4
#: Most steps from the expected pose, and the square over the median one at which a point has half its weight.
_STEPS = 12
_OVER_MEDIAN = 4.0
#: Least depth of a point over the median one, and change of the residuals' median (px) that ends the steps.
_NEAREST = 0.01
_CONVERGED_PX = 0.01


def resected(
    places: np.ndarray, pixels: np.ndarray, matrix: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation (3, 3) world -> camera and position (3,) that points (N, 3) at (N, 2) px agree with; None = none.

    Robust Gauss-Newton steps from the expected ``rotation`` and ``position``.
    """
    focal, before = np.diagonal(matrix)[:2], np.inf
    for _ in range(_STEPS):
        seen = (places - position) @ rotation.T
        x, y, z = seen.T
        z = np.maximum(z, _NEAREST * float(np.median(np.abs(z))) + 1e-12)
        slope = seen[:, :2] / z[:, None]
        rest = focal * slope + matrix[:2, 2] - pixels
        square = np.square(rest).sum(axis=1)
        usual = float(np.median(square))
        if abs(before - np.sqrt(usual)) < _CONVERGED_PX:
            break
        before = float(np.sqrt(usual))
        weight = 1.0 / (1.0 + square / max(AGREES_PX**2, _OVER_MEDIAN * usual))
        # Rows of u and v: by the position, then by a turn in camera axes, as in ``path_residuals``.
        per_unit = (weight / z)[:, None] * focal
        rows = np.empty((len(places), 2, 6))
        rows[:, :, :3] = -per_unit[..., None] * (rotation[:2] - slope[..., None] * rotation[2])
        rows[:, 0, 3:] = np.stack([-slope[:, 0] * y, z + slope[:, 0] * x, -y], axis=1)
        rows[:, 1, 3:] = np.stack([-z - slope[:, 1] * y, slope[:, 1] * x, x], axis=1)
        rows[:, :, 3:] *= per_unit[..., None]
        flat = rows.reshape(-1, 6)
        normal = flat.T @ flat
        try:
            step = np.linalg.solve(normal, -flat.T @ (weight[:, None] * rest).reshape(-1))
        except np.linalg.LinAlgError:
            return None
        position, rotation = position + step[:3], exp_so3(step[3:]) @ rotation
    agree = (square < AGREES_PX**2) & (seen[:, 2] > 0.0)
    return (rotation, position) if agree.sum() >= max(LEAST_POINTS, _LEAST_SHARE * len(places)) else None
