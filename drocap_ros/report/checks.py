"""What a person should know before trusting a motion, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.motion import Motion
from drocap_ros.report.statistics import Measures, mean_known

#: The paper's study of camera speed: little is gained below, and it flew at about 25 degrees per second.
_SLOW_VIEW_DPS = 10.0
_NARROW_VIEW_DEG = 30.0
_SHORT_S, _SHORT_FRAMES = 2.0, 30
_MISSING_SHARE = 0.1
#: Of the body's size in the image.
_HIGH_ERROR = 0.02
#: Keypoints count as outlying from this share of the body's size; more of them than these shares are noted, warned of.
_OUTLYING = 0.08
_SOME_OUTLIERS, _MANY_OUTLIERS = 0.01, 0.1
_BONE_SPREAD = 0.1
_MIRRORED_SHARE, _MIRRORED_COUNT = 0.5, 10


@dataclass(frozen=True)
class Finding:
    """One remark: ``level`` "warning" (doubt the result) or "note" (know how to read it), a title, and a sentence."""

    level: str
    title: str
    text: str


def findings(motion: Motion, m: Measures) -> list[Finding]:
    """Remarks on a motion, warnings first."""
    checks = (_absent, _mirrored, _view, _error, _outliers, _missing, _short, _bones, _vertical, _scale)
    found = [finding for check in checks if (finding := check(motion, m)) is not None]
    return sorted(found, key=lambda finding: finding.level != "warning")


def _absent(motion: Motion, m: Measures) -> Finding | None:
    known = np.isfinite(motion.joints3d).all(axis=2).any(axis=1)
    if known.all():
        return None
    text = f"{np.count_nonzero(~known)} of {len(known)} frames have no 3D pose."
    return Finding("warning", "Frames without a pose", text + " They are empty here and gaps in every export.")


def _mirrored(_: Motion, m: Measures) -> Finding | None:
    if m.bent_knees < _MIRRORED_COUNT or m.knees_forward > _MIRRORED_SHARE:
        return None
    backward = 1.0 - m.knees_forward
    return Finding(
        "warning",
        "Possibly mirrored in depth",
        f"{backward:.0%} of the {m.bent_knees} bent knees bend backward. A body mirrored in depth fits the image"
        " just as well; compare with the video from the side, and check that left and right were not swapped in 2D.",
    )


def _view(_: Motion, m: Measures) -> Finding | None:
    if m.view_speed_dps >= _SLOW_VIEW_DPS and m.view_span_deg >= _NARROW_VIEW_DEG:
        return None
    return Finding(
        "warning",
        "Low camera motion",
        f"The view of the body turned by {m.view_span_deg:.0f}° in all, at {m.view_speed_dps:.0f}°/s (median). Then"
        " depth rests mostly on what poses usually look like. Orbit faster: the paper flew at about 25°/s.",
    )


def _error(_: Motion, m: Measures) -> Finding | None:
    # The median: a few gross outliers in 2D, which the method leaves aside, are no reason to doubt the rest.
    share = m.median_px / m.body_px
    if not share > _HIGH_ERROR:
        return None
    return Finding(
        "warning",
        "High reprojection error",
        f"Half of the joints project more than {m.median_px:.1f} px from their keypoints, {share:.1%} of the body's"
        " size in the image. The 2D keypoints are noisy, or the motion does not explain them.",
    )


def _outliers(motion: Motion, m: Measures) -> Finding | None:
    error = motion.reprojection_px[np.isfinite(motion.reprojection_px)]
    share = float(np.mean(error > _OUTLYING * m.body_px)) if error.size else 0.0
    if not share > _SOME_OUTLIERS:
        return None
    return Finding(
        "warning" if share > _MANY_OUTLIERS else "note",
        "Outlying keypoints",
        f"{share:.1%} of the keypoints lie further than {_OUTLYING:.0%} of the body's size from where the motion puts"
        f" them. They raise the RMS ({m.rms_px:.1f} px) far above the median ({m.median_px:.1f} px).",
    )


def _missing(motion: Motion, m: Measures) -> Finding | None:
    worst = [int(j) for j in np.argsort(-m.missing, kind="stable") if m.missing[j] > _MISSING_SHARE]
    if not worst:
        return None
    named = ", ".join(f"{motion.joints[j]} {m.missing[j]:.0%}" for j in worst[:4])
    more = f" and {len(worst) - 4} more" if len(worst) > 4 else ""
    text = f"Keypoints missing in more than {_MISSING_SHARE:.0%} of the frames: {named}{more}. Their 3D is filled in."
    return Finding("warning", "Many missing joints", text)


def _short(_: Motion, m: Measures) -> Finding | None:
    frames, seconds = len(m.times_s), float(m.times_s[-1])
    if frames >= _SHORT_FRAMES and seconds >= _SHORT_S:
        return None
    return Finding(
        "warning",
        "Short sequence",
        f"{frames} frame{'s' if frames > 1 else ''} over {seconds:.1f} s. Joint adjustment needs many views of a"
        " motion; such a result is close to single-view estimation.",
    )


def _bones(_: Motion, m: Measures) -> Finding | None:
    if len(m.times_s) < 2 or not np.nanmax(m.bone_spread, initial=0.0) > _BONE_SPREAD:
        return None
    worst = int(np.nanargmax(m.bone_spread))
    return Finding(
        "note",
        "Bones change their length",
        f"{m.bones[worst]} varies by {m.bone_spread[worst]:.0%} (standard deviation), all by"
        f" {float(mean_known(m.bone_spread, None)):.0%} on average. Nothing in the method fixes them; BVH export does.",
    )


def _vertical(motion: Motion, _: Measures) -> Finding | None:
    if motion.frame == "world":
        return None
    return Finding(
        "note",
        "Vertical and path not known",
        "Without camera telemetry each pose is as its own image saw it: up is the camera's up, and the body's"
        " path is not known. The player stands it on its lowest joint.",
    )


def _scale(motion: Motion, _: Measures) -> Finding | None:
    if motion.metric:
        return None
    height = motion.meta.get("assumed_height_m")
    assumed = f" of {height:.2f} m" if isinstance(height, int | float) else ""
    source = motion.scale_source.replace("_", " ")
    return Finding("note", "Scale assumed", f"Metres come from {source}{assumed}, not from a measurement.")
