"""Automatic checks of a motion: reasons to doubt it, and notes on how to read it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from drocap_ros.motion import Motion
from drocap_ros.reconstruction.world.calibration_words import telemetry_words
from drocap_ros.report.statistics import Statistics, mean_known
from drocap_ros.skeleton import TOES

#: The paper's study of camera speed: little is gained below, and it flew at about 25 degrees per second.
_SLOW_VIEW_DPS = 10.0
_NARROW_VIEW_DEG = 30.0
#: Elevation of the camera above the body, degrees: from here on the error grows by a fifth, and nearly doubles.
_HIGH_VIEW_DEG, _STEEP_VIEW_DEG = 45.0, 60.0
#: Images per second: below the first errors grow, at the second by half, at 5 threefold.
_FEW_HZ, _LOW_HZ = 20.0, 12.5
_SHORT_S, _SHORT_FRAMES = 2.0, 30
_MISSING_SHARE = 0.1
#: Of the body's size in the image.
_HIGH_ERROR = 0.02
#: Keypoints count as outlying from this share of the body's size; more of them than these shares are noted, warned of.
_OUTLYING = 0.08
_SOME_OUTLIERS, _MANY_OUTLIERS = 0.01, 0.1
_BONE_SPREAD = 0.1
_MIRRORED_SHARE, _MIRRORED_COUNT = 0.5, 10
#: Speed of the lower foot, and its share of the pelvis's speed: no take of 523 with real walks, runs, jumps and squats
#: exceeds the larger of the two.
_SLIDING_M_S, _SLIDING_SHARE = 0.4, 0.3
#: Lean with the camera: 64 true takes, seen from an orbit, reach 3.6 degrees; a mount's pitch off by 10 gives 10.
_LEANING_DEG = 8.0
#: So many warnings make a motion doubtful.
_MANY_WARNINGS = 3


class Level(Enum):
    """Consequence of a check: doubt the motion, or read it with care."""

    WARNING = "warning"
    NOTE = "note"


class Check(Enum):
    """The checks, in the order of the report."""

    MISSING_POSES = auto()
    MIRRORED = auto()
    LOW_CAMERA_MOTION = auto()
    STEEP_VIEW = auto()
    LOW_RATE = auto()
    HIGH_ERROR = auto()
    OUTLIERS = auto()
    SLIDING_FEET = auto()
    LEANING = auto()
    MISSING_JOINTS = auto()
    ESTIMATED_FEET = auto()
    SHORT = auto()
    BONE_LENGTHS = auto()
    NO_VERTICAL = auto()
    ASSUMED_SCALE = auto()
    TELEMETRY_REJECTED = auto()
    TELEMETRY_JUMPS = auto()
    CALIBRATION = auto()


@dataclass(frozen=True)
class CheckResult:
    """A check that applies; ``values`` fill in its words."""

    check: Check
    level: Level
    values: dict[str, float | str]

    @property
    def title(self) -> str:
        """A few words."""
        return _WORDS[self.check][0]

    @property
    def text(self) -> str:
        """One to three sentences."""
        return _WORDS[self.check][1].format(**self.values)


_WORDS: dict[Check, tuple[str, str]] = {
    Check.MISSING_POSES: (
        "Frames without a pose",
        "{missing} of {frames} frames have no 3D pose. They are empty here and gaps in every export.",
    ),
    Check.MIRRORED: (
        "Possibly mirrored in depth",
        "{backward:.0%} of the {bent} bent knees bend backward. A body mirrored in depth fits the image equally well;"
        " compare with the video from the side, and check that left and right were not exchanged in 2D.",
    ),
    Check.LOW_CAMERA_MOTION: (
        "Low camera motion",
        "The view of the body turned by {span:.0f}° in all, at {speed:.0f}°/s (median). Depth then rests mostly on"
        " ordinary poses. Orbit faster: the paper flew at about 25°/s.",
    ),
    Check.STEEP_VIEW: (
        "Steep view",
        "The camera looks at the body from {elevation:.0f}° above (median). Limbs are foreshortened and hide each"
        " other, so the joints err more. Fly lower or farther away; below {limit:.0f}° the view does not limit the"
        " result.",
    ),
    Check.LOW_RATE: (
        "Low image rate",
        "{rate:.1f} images per second. Fast motions fall between the images, so the joints err more. Record at"
        " {limit:.0f} or more.",
    ),
    Check.HIGH_ERROR: (
        "High reprojection error",
        "Half of the joints project more than {px:.1f} px from their keypoints, {share:.1%} of the body's size in the"
        " image. The 2D keypoints are noisy, or the motion does not explain them.",
    ),
    Check.OUTLIERS: (
        "Outlying keypoints",
        "{share:.1%} of the keypoints lie more than {limit:.0%} of the body's size from the projected joints. They"
        " raise the RMS ({rms:.1f} px) far above the median ({median:.1f} px).",
    ),
    Check.SLIDING_FEET: (
        "Sliding feet",
        "The lower foot moves at {speed:.2f} m/s (median); the foot of a person that walks or stands rests. The path,"
        " the scale or the depths are wrong, or the person glides.",
    ),
    Check.LEANING: (
        "Body leans with the camera",
        "From every side the body leans {lean:.0f}° {where} the camera. The camera's reported pitch is wrong by about"
        " as much, and so is the body's place: check the pitch of the mount and its sign, negative = down.",
    ),
    Check.MISSING_JOINTS: (
        "Many missing joints",
        "Keypoints missing in more than {limit:.0%} of the frames: {joints}. Their 3D is filled in.",
    ),
    Check.ESTIMATED_FEET: (
        "Feet estimated",
        "The 2D network shows no toes: their 3D is the lifter's estimate. A network of 26 or 133 joints shows them.",
    ),
    Check.SHORT: (
        "Short sequence",
        "Frames: {frames}, over {seconds:.1f} s. Joint adjustment needs many views of a motion; such a result is close"
        " to single-view estimation.",
    ),
    Check.BONE_LENGTHS: (
        "Bones change their length",
        "{bone} varies by {worst:.0%} (standard deviation), all by {mean:.0%} on average. No method fixes bone lengths"
        " exactly; BVH export does.",
    ),
    Check.NO_VERTICAL: (
        "Vertical and path not known",
        "Without camera telemetry each pose is in the axes of its own image: up is the camera's up, and the body's"
        " path is not known. The player stands it on its lowest joint.",
    ),
    Check.TELEMETRY_REJECTED: ("Telemetry not used", "{words} The motion stays in the axes of the camera."),
    Check.TELEMETRY_JUMPS: ("Reported position jumps", "{words}"),
    Check.CALIBRATION: ("Telemetry corrected", "{words}"),
    Check.ASSUMED_SCALE: ("Scale assumed", "Metres come from {source}{height}, not from a measurement."),
}


#: Checks that alone make a motion doubtful.
_DOUBTFUL = (Check.MIRRORED, Check.HIGH_ERROR, Check.SLIDING_FEET)


def run_checks(motion: Motion, s: Statistics) -> list[CheckResult]:
    """The checks that apply to a motion, warnings first."""
    checks = (
        _missing_poses,
        _mirrored,
        _low_camera_motion,
        _steep_view,
        _low_rate,
        _high_error,
        _outliers,
        _sliding_feet,
        _leaning,
        _missing_joints,
        _estimated_feet,
        _short,
        _bone_lengths,
        _no_vertical,
        _assumed_scale,
        _telemetry,
    )
    results = [result for check in checks if (result := check(motion, s)) is not None]
    return sorted(results, key=lambda result: result.level is not Level.WARNING)


def quality_sentence(results: Sequence[CheckResult]) -> str:
    """One sentence on the quality of a motion: good, fair or doubtful, and the warnings."""
    warnings = [result for result in results if result.level is Level.WARNING]
    if not warnings:
        return "quality: good, no check doubts this motion"
    doubtful = len(warnings) >= _MANY_WARNINGS or any(w.check in _DOUBTFUL for w in warnings)
    titles = ", ".join(w.title[0].lower() + w.title[1:] for w in warnings)
    return f"quality: {'doubtful' if doubtful else 'fair'}, {len(warnings)} warning{'s'[: len(warnings) > 1]}: {titles}"


def _warn(check: Check, **values: float | str) -> CheckResult:
    return CheckResult(check, Level.WARNING, values)


def _note(check: Check, **values: float | str) -> CheckResult:
    return CheckResult(check, Level.NOTE, values)


def _missing_poses(motion: Motion, s: Statistics) -> CheckResult | None:
    missing = ~np.isfinite(motion.joints3d).all(axis=2).any(axis=1)
    if not missing.any():
        return None
    return _warn(Check.MISSING_POSES, missing=np.count_nonzero(missing), frames=len(missing))


def _mirrored(motion: Motion, s: Statistics) -> CheckResult | None:
    if s.bent_knees < _MIRRORED_COUNT or s.knees_forward > _MIRRORED_SHARE:
        return None
    return _warn(Check.MIRRORED, backward=1.0 - s.knees_forward, bent=s.bent_knees)


def _low_camera_motion(motion: Motion, s: Statistics) -> CheckResult | None:
    if s.view_speed_dps >= _SLOW_VIEW_DPS and s.view_span_deg >= _NARROW_VIEW_DEG:
        return None
    return _warn(Check.LOW_CAMERA_MOTION, span=s.view_span_deg, speed=s.view_speed_dps)


def _steep_view(motion: Motion, s: Statistics) -> CheckResult | None:
    if not s.elevation_deg > _HIGH_VIEW_DEG:
        return None
    result = _warn if s.elevation_deg > _STEEP_VIEW_DEG else _note
    return result(Check.STEEP_VIEW, elevation=s.elevation_deg, limit=_HIGH_VIEW_DEG)


def _low_rate(motion: Motion, s: Statistics) -> CheckResult | None:
    if not 0.0 < s.rate_hz < _FEW_HZ:
        return None
    result = _warn if s.rate_hz < _LOW_HZ else _note
    return result(Check.LOW_RATE, rate=s.rate_hz, limit=_FEW_HZ)


def _high_error(motion: Motion, s: Statistics) -> CheckResult | None:
    # The median: a few gross outliers in 2D, which the method ignores, are no reason to doubt the rest.
    share = s.median_px / s.body_px
    return _warn(Check.HIGH_ERROR, px=s.median_px, share=share) if share > _HIGH_ERROR else None


def _outliers(motion: Motion, s: Statistics) -> CheckResult | None:
    error = motion.reprojection_px[np.isfinite(motion.reprojection_px)]
    share = float(np.mean(error > _OUTLYING * s.body_px)) if error.size else 0.0
    if not share > _SOME_OUTLIERS:
        return None
    result = _warn if share > _MANY_OUTLIERS else _note
    return result(Check.OUTLIERS, share=share, limit=_OUTLYING, rms=s.rms_px, median=s.median_px)


def _sliding_feet(motion: Motion, s: Statistics) -> CheckResult | None:
    if not s.foot_m_s > max(_SLIDING_M_S, _SLIDING_SHARE * s.pelvis_m_s):
        return None
    return _warn(Check.SLIDING_FEET, speed=s.foot_m_s)


def _leaning(motion: Motion, s: Statistics) -> CheckResult | None:
    if not abs(s.lean_deg) > _LEANING_DEG:
        return None
    return _warn(Check.LEANING, lean=abs(s.lean_deg), where="away from" if s.lean_deg > 0 else "towards")


def _missing_joints(motion: Motion, s: Statistics) -> CheckResult | None:
    worst = [int(j) for j in np.argsort(-s.missing, kind="stable") if s.missing[j] > _MISSING_SHARE]
    if _unseen_toes(motion, s):
        worst = [j for j in worst if motion.joints[j] not in TOES]
    if not worst:
        return None
    named = ", ".join(f"{motion.joints[j]} {s.missing[j]:.0%}" for j in worst[:4])
    more = f" and {len(worst) - 4} more" if len(worst) > 4 else ""
    return _warn(Check.MISSING_JOINTS, limit=_MISSING_SHARE, joints=named + more)


def _unseen_toes(motion: Motion, s: Statistics) -> bool:
    """Whether the motion has toes that no image shows."""
    toes = [motion.joints.index(name) for name in TOES if name in motion.joints]
    return bool(toes) and bool((s.missing[toes] == 1.0).all())


def _estimated_feet(motion: Motion, s: Statistics) -> CheckResult | None:
    return _note(Check.ESTIMATED_FEET) if _unseen_toes(motion, s) else None


def _short(motion: Motion, s: Statistics) -> CheckResult | None:
    frames, seconds = len(s.times_s), float(s.times_s[-1])
    if frames >= _SHORT_FRAMES and seconds >= _SHORT_S:
        return None
    return _warn(Check.SHORT, frames=frames, seconds=seconds)


def _bone_lengths(motion: Motion, s: Statistics) -> CheckResult | None:
    if len(s.times_s) < 2 or not np.nanmax(s.bone_spread, initial=0.0) > _BONE_SPREAD:
        return None
    worst = int(np.nanargmax(s.bone_spread))
    mean = float(mean_known(s.bone_spread, None))
    return _note(Check.BONE_LENGTHS, bone=s.bones[worst], worst=float(s.bone_spread[worst]), mean=mean)


def _no_vertical(motion: Motion, s: Statistics) -> CheckResult | None:
    return None if motion.frame == "world" else _note(Check.NO_VERTICAL)


def _assumed_scale(motion: Motion, s: Statistics) -> CheckResult | None:
    if motion.metric:
        return None
    height = motion.meta.get("assumed_height_m")
    assumed = f" of {height:.2f} m" if isinstance(height, int | float) else ""
    return _note(Check.ASSUMED_SCALE, source=motion.scale_source.replace("_", " "), height=assumed)


def _telemetry(motion: Motion, s: Statistics) -> CheckResult | None:
    words = telemetry_words(motion.meta)
    if not words:
        return None
    if "telemetry_rejected" in motion.meta:
        return _warn(Check.TELEMETRY_REJECTED, words=words)
    if any(window.get("camera_jumps_m", 0.0) > 0 for window in motion.meta["calibration"]):
        return _warn(Check.TELEMETRY_JUMPS, words=words)
    return _note(Check.CALIBRATION, words=words)
