"""Which single error of the telemetry explains what the points correct: yaw, pitch, roll, or stamps that are off.

Every cause is fitted alone to the difference of the two paths, weighed by the information of the points: the parts
that no point sees, as the place of the whole path, count for none.  Slow errors as configured explain the rest.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from drocap_ros.geometry.rotations import log_so3
from drocap_ros.reconstruction.camera.path_adjustment import ENOUGH_POINTS, AdjustedPath
from drocap_ros.reconstruction.camera.path_model import KNOT, SHARED, PathConfig, PathInput, PathState
from drocap_ros.reconstruction.camera.path_residuals import OUTLIER_SQUARE, PathEquations, PathResiduals, weights_of
from drocap_ros.reconstruction.common.engine import band_factor, forward
from drocap_ros.reconstruction.world.camera_telemetry import CameraTelemetry

#: The causes: what is off, and its unit per rad; or per s of a path that was reported so much too early, as stamps are
#: corrected the other way.
_DEG, _MS = 180.0 / np.pi, -1000.0
_CAUSES = (
    ("gimbal pitch", _DEG, "deg"),
    ("gimbal yaw", _DEG, "deg"),
    ("gimbal roll", _DEG, "deg"),
    ("attitude's stamps", _MS, "ms"),
    ("position's stamps", _MS, "ms"),
    ("all stamps", _MS, "ms"),
)


def single_causes(
    given: CameraTelemetry, found: AdjustedPath, matrix: np.ndarray, config: PathConfig
) -> list[dict[str, Any]]:
    """JSON-compatible causes that explain most of the difference, the best first; [] = no single one does.

    The points cannot distinguish the others from the first.  ``config`` : the expected errors
    """
    # A cause is sought from two standard deviations of a constant error from zero.
    if not (np.abs(found.shared) > 2.0 * found.shared_std).any():
        return []
    path = CameraTelemetry(found.rotation, found.position, given.fps)
    data = PathInput(
        path,
        matrix,
        found.views,
        replace(config, errors=replace(config.errors, tilt_deg=0.0, yaw_deg=0.0, latency_s=0.0), focal=0.0),
    )
    knots, at_knots = data.knots, np.zeros(given.frames, bool)
    at_knots[knots.frame] = True
    views, kept = found.views.at_frames(at_knots)
    if not len(views.frame):
        return []
    unit, weights = found.state.unit, weights_of(data)
    points = found.points[kept] / np.array([unit] * 3 + [1.0])
    none = np.zeros((knots.count, KNOT))
    state = PathState(none, np.zeros((given.frames, KNOT)), np.zeros(SHARED), points, unit)
    free = weights._replace(change=0 * weights.change, first=0 * weights.first, acceleration=0.0)
    by_points, expected = (
        PathEquations(PathResiduals(replace(data, views=views), w, state, OUTLIER_SQUARE)).band
        for w in (free, weights._replace(acceleration=0.0))
    )
    factor = band_factor(expected.copy())
    if factor is None:
        return []
    columns = _columns(given, found, knots.frame)
    seen = _product(by_points, columns)
    y = forward(factor, seen)
    gram = (columns.T @ seen - y.T @ y) / config.views_per_fact
    total = float(gram[0, 0])
    # One per unknown of a knot is what the configured slow errors explain.
    if total < knots.count * KNOT / config.views_per_fact:
        return []
    size = gram[1:, 0] / np.diag(gram)[1:]
    std, gain = np.diag(gram)[1:] ** -0.5, size * gram[1:, 0]
    # Another cause explains less by three standard deviations, or not most of the difference.
    order = [int(i) for i in np.argsort(-gain) if gain[i] > gain.max() - 3.0**2 and gain[i] > 0.6 * total]
    return [
        {
            "cause": _CAUSES[i][0],
            "size": float(size[i] * _CAUSES[i][1]),
            "std": float(std[i] * abs(_CAUSES[i][1])),
            "unit": _CAUSES[i][2],
            "explains": float(gain[i] / total),
        }
        for i in order
    ]


def _columns(given: CameraTelemetry, found: AdjustedPath, frame: np.ndarray) -> np.ndarray:
    """(6 K, 1 + causes) the difference of the paths at the knots, and what one rad or s of every cause makes of it."""
    columns = np.zeros((len(frame), KNOT, 1 + len(_CAUSES)))
    columns[:, :3, 0] = (found.position - given.position)[frame]
    columns[:, 3:, 0] = log_so3(found.rotation @ np.swapaxes(given.rotation, 1, 2))[frame]
    columns[:, 3:, 1:4] = given.gimbal_axes().T
    columns[:, 3:, 4], columns[:, :3, 5] = given.turn_rate[frame], given.velocity[frame]
    columns[:, :, 6] = columns[:, :, 4] + columns[:, :, 5]
    return columns.reshape(-1, 1 + len(_CAUSES))


def _product(band: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """A symmetric band (N, W), element [i, d] of i and i + d, times columns (N, M)."""
    out = band[:, :1] * columns
    for distance in range(1, min(band.shape[1], len(band))):
        beside = band[:-distance, distance, None]
        out[:-distance] += beside * columns[distance:]
        out[distance:] += beside * columns[:-distance]
    return np.asarray(out)


def contradicted_share(found: AdjustedPath) -> float:
    """Share of the frames whose points lie elsewhere than the corrected path sees most of them."""
    frame, frames = found.views.frame, len(found.rotation)
    # An observation fits with a quarter of the weight.
    seen, fit = np.bincount(frame, minlength=frames), np.bincount(frame, found.weight > 0.25, minlength=frames)
    # Where fewer than a quarter of the points fit, most lie elsewhere.
    return float(((seen >= ENOUGH_POINTS) & (fit < 0.25 * seen)).mean())
