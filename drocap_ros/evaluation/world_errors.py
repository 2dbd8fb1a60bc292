"""All errors of one motion in the world, and their cells of a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.evaluation import world_metrics
from drocap_ros.evaluation.metrics import SEGMENT, horizon_error, pa_mpjpe, scale_error, w_mpjpe
from drocap_ros.skeleton import BODY_15

WORLD_HEAD = [
    "PA-MPJPE mm", "MPJPE mm", "W-MPJPE mm", "WA-MPJPE mm", "not aligned mm", "RTE %", "scale %", "horizon deg",
    "still feet m/s (mm per frame)", "penetration mm", "acceleration ratio", "acceleration error m/s^2",
    "in 90 % ellipsoid",
]  # fmt: skip


@dataclass(frozen=True)
class WorldErrors:
    """Errors of one motion in the world; :mod:`world_metrics` defines them.

    absolute_mm : mean distance of the joints without any alignment
    root_percent : RTE, percent of the true path
    scale : estimated over true mean limb length, less 1
    foot_m_s, foot_mm : speed of the ankles where the true ones are still, and their step between two frames
    acceleration_ratio : mean acceleration over the truth's; NaN = the truth does not move
    coverage : share of the joints within their own 90 % ellipsoids; NaN = the motion has none, or one about the pelvis
    """

    pa_mm: float
    mpjpe_mm: float
    w_mm: float
    wa_mm: float
    absolute_mm: float
    root_percent: float
    scale: float
    horizon_deg: float
    foot_m_s: float
    foot_mm: float
    penetration_mm: float
    acceleration_ratio: float
    acceleration_error_m_s2: float
    coverage: float = float("nan")


def world_errors(
    estimate: np.ndarray, truth: np.ndarray, rate_hz: world_metrics.Rate, covariance: np.ndarray | None = None
) -> WorldErrors:
    """Errors of joints (F, P, 3) m in the world against the truth, both z up; means are over ``BODY_15``.

    Neck and head may be NaN: the means are then over the other joints.

    rate_hz : frames per second, one number or (F - 1) of the steps
    covariance : (F, P, 6) m^2 of the estimate, or None
    """
    estimate, truth = estimate[:, : len(BODY_15)], truth[:, : len(BODY_15)]
    nan = float("nan")
    moving = len(truth) > 2
    foot = world_metrics.still_foot_speed(estimate, truth, rate_hz) if moving else nan
    known = (np.isfinite(estimate) & np.isfinite(truth)).all(axis=(0, 2))
    est, tru = estimate[:, known], truth[:, known]
    return WorldErrors(
        pa_mm=1000 * float(pa_mpjpe(estimate, truth).mean()),
        mpjpe_mm=1000 * float(world_metrics.mpjpe(est, tru).mean()),
        w_mm=1000 * float(w_mpjpe(est, tru).mean()),
        wa_mm=1000 * float(w_mpjpe(est, tru, SEGMENT).mean()),
        absolute_mm=1000 * float(np.linalg.norm(est - tru, axis=-1).mean()),
        root_percent=100 * world_metrics.root_error(estimate, truth) if moving else nan,
        scale=scale_error(estimate, truth),
        horizon_deg=float(np.degrees(horizon_error(estimate, truth)).mean()),
        foot_m_s=foot,
        foot_mm=1000 * foot / float(np.median(rate_hz)) if moving else nan,
        penetration_mm=1000 * world_metrics.penetration(estimate, truth),
        acceleration_ratio=world_metrics.acceleration_ratio(est, tru, rate_hz) if moving else nan,
        acceleration_error_m_s2=world_metrics.acceleration_error(est, tru, rate_hz) if moving else nan,
        coverage=nan
        if covariance is None
        else world_metrics.ellipsoid_coverage(est, tru, covariance[:, : len(BODY_15)][:, known]),
    )


def world_cells(e: WorldErrors) -> list[str]:
    """Cells under :data:`WORLD_HEAD`; "-" where an error is not known."""
    foot = "-" if np.isnan(e.foot_m_s) else f"{e.foot_m_s:.2f} ({e.foot_mm:.1f})"
    return [
        _cell(e.pa_mm, ".1f"), _cell(e.mpjpe_mm, ".1f"), _cell(e.w_mm, ".0f"), _cell(e.wa_mm, ".0f"),
        _cell(e.absolute_mm, ".0f"), _cell(e.root_percent, ".1f"), _cell(100 * e.scale, "+.1f"),
        _cell(e.horizon_deg, ".1f"), foot, _cell(e.penetration_mm, ".0f"), _cell(e.acceleration_ratio, ".2f"),
        _cell(e.acceleration_error_m_s2, ".1f"), _cell(e.coverage, ".0%"),
    ]  # fmt: skip


def _cell(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)
