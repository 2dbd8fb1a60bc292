"""Comparison of one motion with its truth: ``drocap evaluate compare``."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.evaluation import metrics
from drocap_ros.evaluation.time_offset import find_offset
from drocap_ros.evaluation.truth_files import load_mocap, metres_of, read_truth_file
from drocap_ros.file_kind import file_kind
from drocap_ros.motion import Motion, load_motion, motion_file
from drocap_ros.skeleton import BODY_15, BODY_17, LIMB_JOINTS, in_body_order, indices
from drocap_ros.tracks import kind_of, read_npz, wrong_kind

logger = logging.getLogger(__name__)

#: Endings of files of a truth.
TRUTH_SUFFIXES = (".npz", ".c3d", ".trc", ".bvh")
_LIMBS = indices(BODY_15.joints, LIMB_JOINTS)


@dataclass(frozen=True)
class WorldErrors:
    """Errors of one motion in the world; :mod:`metrics` defines them.

    absolute_mm : mean distance of the joints without any alignment
    root_percent : RTE, percent of the true path
    scale : estimated over true mean limb length, less 1
    foot_m_s, foot_mm : speed of the ankles where the true ones are still, and their step between two frames
    acceleration_ratio : mean acceleration over the truth's; NaN = the truth does not move
    coverage : share of the joints within their own 90 % ellipsoids; NaN = the motion has none, or one about the pelvis
    coverage_about : the same about the recording's mean place, whose error all joints of all frames have in common
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
    coverage_about: float = float("nan")


def world_errors(
    estimate: np.ndarray,
    truth: np.ndarray,
    rate_hz: metrics.Rate,
    covariance: np.ndarray | None = None,
    place: np.ndarray | None = None,
) -> WorldErrors:
    """Errors of joints (F, P, 3) m in the world against the truth, both z up; means are over ``BODY_15``.

    Neck and head may be NaN: the means are then over the other joints.

    rate_hz : frames per second, one number or (F - 1) of the steps
    covariance : (F, P, 6) m^2 of the estimate, or None
    place : (6,) m^2, the part of it that all joints of all frames have in common, or None
    """
    estimate, truth = estimate[:, : len(BODY_15)], truth[:, : len(BODY_15)]
    nan = float("nan")
    moving = len(truth) > 2
    foot = metrics.still_foot_speed(estimate, truth, rate_hz) if moving else nan
    known = (np.isfinite(estimate) & np.isfinite(truth)).all(axis=(0, 2))
    est, tru = estimate[:, known], truth[:, known]
    own = None if covariance is None else covariance[:, : len(BODY_15)][:, known]
    about = None if own is None or place is None else own - place
    return WorldErrors(
        pa_mm=1000 * float(metrics.pa_mpjpe(estimate, truth).mean()),
        mpjpe_mm=1000 * float(metrics.mpjpe(est, tru).mean()),
        w_mm=1000 * float(metrics.w_mpjpe(est, tru).mean()),
        wa_mm=1000 * float(metrics.w_mpjpe(est, tru, metrics.SEGMENT).mean()),
        absolute_mm=1000 * float(np.linalg.norm(est - tru, axis=-1).mean()),
        root_percent=100 * metrics.root_error(estimate, truth) if moving else nan,
        scale=metrics.scale_error(estimate, truth),
        horizon_deg=float(np.degrees(metrics.horizon_error(estimate, truth)).mean()),
        foot_m_s=foot,
        foot_mm=1000 * foot / float(np.median(rate_hz)) if moving else nan,
        penetration_mm=1000 * metrics.penetration(estimate, truth),
        acceleration_ratio=metrics.acceleration_ratio(est, tru, rate_hz) if moving else nan,
        acceleration_error_m_s2=metrics.acceleration_error(est, tru, rate_hz) if moving else nan,
        coverage=_coverage(est, tru, own),
        coverage_about=_coverage(est - (est - tru).mean(axis=(0, 1)), tru, about),
    )


def _coverage(estimate: np.ndarray, truth: np.ndarray, covariance: np.ndarray | None) -> float:
    return float("nan") if covariance is None else metrics.ellipsoid_coverage(estimate, truth, covariance)


def place_covariance(motion: Motion) -> np.ndarray | None:
    """(6,) m^2 xx xy xz yy yz zz of a motion's mean place in the world; None = unknown."""
    windows = motion.meta.get("calibration")
    found = [window.get("place_covariance_m2") for window in windows] if isinstance(windows, list) else []
    return np.mean(found, axis=0) if found and all(place is not None for place in found) else None


@dataclass(frozen=True)
class MotionErrors:
    """Errors of one motion.

    error_mm, per_group_mm : reconstruction error (PA-MPJPE), over all limb joints and per joint group
    mirrored, mirrored_share : handedness of the whole sequence, share of mirrored frames
    scale_error : estimated over true mean limb length, less 1
    metric : the motion's scale is measured, not assumed
    world : errors in the world where both motions are in world frames, else None
    toe_mm : error of the toes after the alignment over the limb joints, NaN where either motion has none
    """

    frames: int
    error_mm: float
    per_group_mm: dict[str, float]
    mirrored: bool
    mirrored_share: float
    scale_error: float
    metric: bool
    world: WorldErrors | None = None
    toe_mm: float = float("nan")


def load_truth(truth: Motion | str | Path) -> tuple[np.ndarray, np.ndarray, str]:
    """True joints (T, 17, 3) in m, their times (T,) in s and their frame, of a motion, or of a file of one or of MoCap.

    The file is a MoCap or motion ``.npz``, C3D, TRC or BVH; in a folder ``truth`` with one of these endings, else
    ``motion.npz``.  It has to hold the twelve limb joints; others that it lacks are NaN.
    """
    if not isinstance(truth, Motion):
        path = motion_file(truth, *(f"truth{suffix}" for suffix in TRUTH_SUFFIXES))
        name, sign, subject = path.name.rpartition("#")
        path, subject = (path.with_name(name), subject) if sign and not path.exists() else (path, "")
        if path.is_file() and (found := read_truth_file(path, subject)) is not None:
            return *found, "world"
        if path.is_file() and path.suffix.lower() != ".npz":
            raise InputError(
                f"{path}: expected a truth as MoCap .npz, .c3d, .trc, .bvh or a motion.npz, found"
                f" {file_kind(path).value}; convert it (FBX to BVH by Blender)"
            )
        names = read_npz(path, ())
        kind = kind_of(names)
        if not kind and {"X", "joints"} <= names.keys():
            raise InputError(
                f"{path}: expected fps beside X (T, P, 3) in mm and joints, found none; add the frame rate"
            )
        if kind == "MoCap":
            x, fps = load_mocap(path, LIMB_JOINTS, BODY_17)
            return metres_of(path, x), np.arange(len(x)) / fps, "world"
        if kind != "motion":
            raise wrong_kind(path, names, "MoCap or a motion as the truth")
        truth = load_motion(path)
    return in_body_order(truth.joints3d, truth.joints, LIMB_JOINTS), truth.stamp_ns * 1e-9, truth.frame


def compare(
    motion: Motion, truth: np.ndarray, time_s: np.ndarray, frame: str, offset_s: float | None = None
) -> MotionErrors:
    """Errors of a motion against joints (T, P, 3) m, of BODY_15 or BODY_17, at increasing times (T,) s.

    Only joints that both have are compared; the twelve limb joints are required.  The truth is interpolated at the
    motion's times; frames outside its range, or where it has gaps, are left out.

    offset_s : from the truth's first frame to the motion's; NaN = to be found by the poses; None = times are absolute
        where both ranges overlap, else it is found, and where no offset is clear both start at zero
    """
    estimate = in_body_order(motion.joints3d, motion.joints, LIMB_JOINTS)
    truth = in_body_order(truth, BODY_17.joints[: truth.shape[1]], LIMB_JOINTS)
    known = np.isfinite(estimate).any(axis=(0, 2)) & np.isfinite(truth).any(axis=(0, 2))
    known[_LIMBS] = True
    at = motion.stamp_ns * 1e-9
    apart = at[-1] < time_s[0] or at[0] > time_s[-1]
    if apart or offset_s is not None:
        at, time_s = at - at[0], time_s - time_s[0]
        at = at + (
            _found_offset(estimate, at, truth, time_s, apart) if offset_s is None or np.isnan(offset_s) else offset_s
        )
    usable = (at >= time_s[0] - 1e-6) & (at <= time_s[-1] + 1e-6) & np.isfinite(estimate[:, known]).all(axis=(1, 2))
    if not usable.any():
        raise InputError(
            "evaluate compare: expected poses within the truth's time, found none; check that the files belong together"
        )
    true = _at_times(truth, time_s, at)
    whole = usable & np.isfinite(true[:, known]).all(axis=(1, 2))
    if not whole.any():
        raise InputError("evaluate compare: expected a truth of finite joints, got NaN or infinity; fill the gaps in")
    if gaps := np.count_nonzero(usable & ~whole):
        logger.warning("%d of %d poses lie in gaps of the truth: left out", gaps, np.count_nonzero(usable))
    usable = whole
    estimate = np.where(known[:, None], estimate[usable], np.nan)
    true = np.where(known[:, None], true[usable], np.nan)
    in_world = None
    if motion.frame == "world" and frame == "world":
        covariance = None
        if motion.covariance is not None and motion.meta.get("covariance_about") != "pelvis":
            covariance = in_body_order(motion.covariance, motion.joints, LIMB_JOINTS)[usable]
        place = None if covariance is None else place_covariance(motion)
        in_world = world_errors(estimate, true, 1 / np.diff(at[usable]), covariance, place)
    return MotionErrors(
        frames=len(estimate),
        error_mm=1000.0 * float(metrics.pa_mpjpe(estimate, true).mean()),
        per_group_mm={name: 1000.0 * value for name, value in metrics.group_errors(estimate, true).items()},
        mirrored=metrics.is_mirrored(estimate, true),
        mirrored_share=float(metrics.mirrored_frames(estimate, true).mean()),
        scale_error=metrics.scale_error(estimate, true),
        metric=motion.metric,
        world=in_world,
        toe_mm=1000.0 * metrics.toe_error(estimate, true),
    )


def _found_offset(estimate: np.ndarray, at: np.ndarray, truth: np.ndarray, time_s: np.ndarray, apart: bool) -> float:
    """Seconds from the truth's first frame to the motion's, by the poses; 0 where none is clear."""
    reason = "the times of motion and truth do not overlap" if apart else "time offset"
    found = find_offset(estimate, at, truth, time_s)
    if found is None:
        logger.warning("%s, and no offset is clear by the poses: both are compared from their first frame on", reason)
        return 0.0
    logger.warning("%s: by the poses the motion begins %.2f s after the truth (--time-offset S)", reason, found[0])
    return found[0]


def _at_times(values: np.ndarray, time_s: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    if len(time_s) == 1:
        return np.broadcast_to(values, (len(wanted), *values.shape[1:]))
    after = np.clip(np.searchsorted(time_s, wanted, side="right"), 1, len(time_s) - 1)
    share = (wanted - time_s[after - 1]) / (time_s[after] - time_s[after - 1])
    share = np.clip(share, 0.0, 1.0)[:, None, None]
    return np.asarray(values[after - 1] * (1 - share) + values[after] * share)
