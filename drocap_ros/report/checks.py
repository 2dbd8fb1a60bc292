"""Automatic checks of a motion: reasons to doubt it, and notes on how to read it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from drocap_ros.contacts import MOTION_REST_M_S
from drocap_ros.motion import Motion
from drocap_ros.reconstruction.world.telemetry_words import telemetry_words
from drocap_ros.recording.keypoints.body_check import is_no_body
from drocap_ros.report.statistics import Statistics, mean_known
from drocap_ros.skeleton import TOES

#: Speed of the view, degrees per second: the paper's study gains little below it; the paper flew at about 25.
_SLOW_VIEW_DPS = 10.0
#: Range of the view, degrees; a judgement: somewhat more than a second of the paper's orbit.
_NARROW_VIEW_DEG = 30.0
#: Elevation of the camera above the body, degrees: from the first on the error grows by a fifth, and nearly doubles.
_HIGH_VIEW_DEG = 45.0
_STEEP_VIEW_DEG = 60.0  # deg: the error nearly doubles
#: Images per second: below the first errors grow, at the second by half, at 5 threefold.
_FEW_HZ = 20.0
_LOW_HZ = 12.5  # images/s: half as much again
#: Seconds and frames; a judgement: with fewer there are few views to join.
_SHORT_S = 2.0
_SHORT_FRAMES = 30  # frames: a second at the usual rate
#: Share of the frames without a joint's keypoint; a judgement.
_MISSING_SHARE = 0.1
#: Standard deviation of a bone's length over its mean; a judgement.
_BONE_SPREAD = 0.1
#: Distance of keypoints from a body that fits several recordings over that from their own: right pairs have up to 1.9.
_MISFIT = 2.0
#: Median reprojection error, share of the body's size in the image; a judgement.
_HIGH_ERROR = 0.02
#: Keypoints count as outlying from this share of the body's size on; a judgement.
_OUTLYING = 0.08
#: Shares of outlying keypoints that are noted and warned of; a judgement: the method ignores few.
_SOME_OUTLIERS = 0.01
_MANY_OUTLIERS = 0.1  # share; a judgement
#: Share of forward knees at which a body is no likelier right than mirrored, and the least number of bent knees.
_MIRRORED_SHARE = 0.5
_MIRRORED_COUNT = 10  # knees; a judgement: with fewer the share is chance
#: Share of the pelvis's speed: the lower foot of no take of 523 with real walks, runs, jumps and squats exceeds the
#: larger of it and of ``MOTION_REST_M_S``.
_SLIDING_SHARE = 0.3
#: Lean with the camera: 64 true takes, seen from an orbit, reach 3.6 degrees; a mount's pitch off by 10 gives 10.
_LEANING_DEG = 8.0
#: So many warnings make a motion doubtful; a judgement.
_MANY_WARNINGS = 3


class Severity(Enum):
    """Consequence of a finding: doubt the motion, or read it with care."""

    WARNING = "warning"
    NOTE = "note"


class MotionCheck(Enum):
    """The checks, in the order of the report: a title, and one to three sentences with places for the values."""

    MISSING_POSES = (
        "Frames without a pose",
        "{missing} of {frames} frames have no 3D pose. They are empty here and gaps in every export.",
    )
    MIRRORED = (
        "Possibly mirrored in depth",
        "{backward:.0%} of the {bent} bent knees bend backward. A body mirrored in depth fits the image equally well;"
        " compare with the video from the side, and check that left and right were not exchanged in 2D.",
    )
    MISFIT = (
        "Recordings do not fit",
        "Half of the keypoints of {name} lie more than {px:.1f} px from the body that fits all recordings, {alone:.1f}"
        " from its own. They may show another person or another time; look at both from the same side.",
    )
    ONE_VIEW = (
        "One view",
        "The camera stands, and the view of the body turned by {span:.0f}° in all. Depth then rests mostly on ordinary"
        " poses. A second recording from another side (--together) or a camera that moves round the body measures it.",
    )
    LOW_CAMERA_MOTION = (
        "Low camera motion",
        "The view of the body turned by {span:.0f}° in all, at {speed:.0f}°/s (median). Depth then rests mostly on"
        " ordinary poses. Orbit faster: the paper flew at about 25°/s.",
    )
    STEEP_VIEW = (
        "Steep view",
        "The camera looks at the body from {elevation:.0f}° above (median). Limbs are foreshortened and hide each"
        " other, so the joints err more. Fly lower or farther away; below {limit:.0f}° the view does not limit the"
        " result.",
    )
    LOW_RATE = (
        "Low image rate",
        "{rate:.1f} images per second. Fast motions fall between, so joints err more. Record at {limit:.0f} or more.",
    )
    HIGH_ERROR = (
        "High reprojection error",
        "Half of the joints project more than {px:.1f} px from their keypoints, {share:.1%} of the body's size in the"
        " image. The 2D keypoints are noisy, or the motion does not explain them.",
    )
    NO_BODY = (
        "Keypoints of no body",
        "By their places in the image the keypoints are not those of a person with these names: joints are exchanged,"
        " of another order, or upside down. Check the names; `drocap reconstruct --order NAME` replaces them.",
    )
    OUTLIERS = (
        "Outlying keypoints",
        "{share:.1%} of the keypoints lie more than {limit:.0%} of the body's size from the projected joints. They"
        " raise the RMS ({rms:.1f} px) far above the median ({median:.1f} px).",
    )
    SLIDING_FEET = (
        "Sliding feet",
        "The lower foot moves at {speed:.2f} m/s (median); the foot of a person that walks or stands rests. The path,"
        " the scale or the depths are wrong, or the person glides.",
    )
    LEANING = (
        "Body leans with the camera",
        "From every side the body leans {lean:.0f}° {where} the camera. The camera's reported pitch is wrong by about"
        " as much, and so is the body's place: check the pitch of the mount and its sign, negative = down.",
    )
    MISSING_JOINTS = (
        "Many missing joints",
        "Keypoints missing in more than {limit:.0%} of the frames: {joints}. Their 3D is filled in.",
    )
    ESTIMATED_FEET = (
        "Feet estimated",
        "The 2D network shows no toes: their 3D is the lifter's estimate. A network of 26 or 133 joints shows them.",
    )
    SHORT = (
        "Short sequence",
        "Frames: {frames}, over {seconds:.1f} s. Joint adjustment needs many views of a motion; such a result is close"
        " to single-view estimation.",
    )
    BONE_LENGTHS = (
        "Bones change their length",
        "{bone} varies by {worst:.0%} (standard deviation), all by {mean:.0%} on average. No method fixes bone lengths"
        " exactly; BVH export does.",
    )
    NO_VERTICAL = (
        "Vertical and path not known",
        "Without camera telemetry each pose is in the axes of its own image: up is the camera's up, and the body's"
        " path is not known. The player stands it on its lowest joint.",
    )
    ASSUMED_SCALE = ("Scale assumed", "Metres come from {source}{height}, not from a measurement.")
    ZOOM = ("Lens changes", "{words}. Nothing checks the telemetry then; use a clip of one focal length.")
    TELEMETRY_REJECTED = ("Telemetry not used", "{words} The motion stays in the axes of the camera.")
    TELEMETRY_JUMPS = ("Reported position jumps", "{words}")
    CALIBRATION = ("Camera measured", "{words}")
    LEFT_OUT = ("Left out", "{words}.")


@dataclass(frozen=True)
class Finding:
    """A check that applies; ``values`` fill in its words; ``person`` : number of one of several."""

    check: MotionCheck
    severity: Severity
    values: dict[str, float | str]
    person: int | None = None

    @property
    def title(self) -> str:
        """A few words."""
        return self.check.value[0] if self.person is None else f"Person {self.person}: {self.check.value[0]}"

    @property
    def text(self) -> str:
        """One to three sentences."""
        return self.check.value[1].format(**self.values)


#: Checks that alone make a motion doubtful.
_DOUBTFUL = (
    MotionCheck.NO_BODY,
    MotionCheck.MIRRORED,
    MotionCheck.MISFIT,
    MotionCheck.HIGH_ERROR,
    MotionCheck.SLIDING_FEET,
)


def run_checks(motion: Motion, s: Statistics) -> list[Finding]:
    """The findings of a motion, warnings first."""
    found = [*_of_poses(motion, s), *_of_view(motion, s), *_of_keypoints(motion, s), *_of_path(s), *_of_frame(motion)]
    order = list(MotionCheck)
    return sorted(found, key=lambda finding: (finding.severity is Severity.NOTE, order.index(finding.check)))


def quality_sentence(findings: Sequence[Finding]) -> str:
    """One sentence on the quality of a motion: good, fair or doubtful, and the warnings."""
    warnings = [finding for finding in findings if finding.severity is Severity.WARNING]
    if not warnings:
        return "quality: good, no check doubts this motion"
    doubtful = len(warnings) >= _MANY_WARNINGS or any(w.check in _DOUBTFUL for w in warnings)
    titles = ", ".join(w.title[0].lower() + w.title[1:] for w in warnings)
    return f"quality: {'doubtful' if doubtful else 'fair'}, {len(warnings)} warning{'s'[: len(warnings) > 1]}: {titles}"


def _warn(check: MotionCheck, **values: float | str) -> Finding:
    return Finding(check, Severity.WARNING, values)


def _note(check: MotionCheck, **values: float | str) -> Finding:
    return Finding(check, Severity.NOTE, values)


def _of_poses(motion: Motion, s: Statistics) -> Iterator[Finding]:
    missing = ~np.isfinite(motion.joints3d).all(axis=2).any(axis=1)
    frames, seconds = len(s.times_s), float(s.times_s[-1])
    if missing.any():
        yield _warn(MotionCheck.MISSING_POSES, missing=np.count_nonzero(missing), frames=frames)
    if s.bent_knees >= _MIRRORED_COUNT and s.knees_forward <= _MIRRORED_SHARE:
        yield _warn(MotionCheck.MIRRORED, backward=1.0 - s.knees_forward, bent=s.bent_knees)
    if frames < _SHORT_FRAMES or seconds < _SHORT_S:
        yield _warn(MotionCheck.SHORT, frames=frames, seconds=seconds)
    if frames > 1 and np.nanmax(s.bone_spread, initial=0.0) > _BONE_SPREAD:
        worst = int(np.nanargmax(s.bone_spread))
        mean = float(mean_known(s.bone_spread, None))
        yield _note(MotionCheck.BONE_LENGTHS, bone=s.bones[worst], worst=float(s.bone_spread[worst]), mean=mean)


def _of_view(motion: Motion, s: Statistics) -> Iterator[Finding]:
    views = motion.meta.get("together", {}).get("views", ())
    for view in views:
        if view["misfit"] > _MISFIT:
            values = {"px": view["median_px"], "alone": view["median_px_alone"]}
            yield _warn(MotionCheck.MISFIT, name=view["name"], **values)
    if not views and not (s.view_speed_dps >= _SLOW_VIEW_DPS and s.view_span_deg >= _NARROW_VIEW_DEG):
        if motion.meta.get("camera", {}).get("kind") == "stands":
            yield _warn(MotionCheck.ONE_VIEW, span=s.view_span_deg)
        else:
            yield _warn(MotionCheck.LOW_CAMERA_MOTION, span=s.view_span_deg, speed=s.view_speed_dps)
    if s.elevation_deg > _HIGH_VIEW_DEG:
        level = _warn if s.elevation_deg > _STEEP_VIEW_DEG else _note
        yield level(MotionCheck.STEEP_VIEW, elevation=s.elevation_deg, limit=_HIGH_VIEW_DEG)
    if 0.0 < s.rate_hz < _FEW_HZ:
        level = _warn if s.rate_hz < _LOW_HZ else _note
        yield level(MotionCheck.LOW_RATE, rate=s.rate_hz, limit=_FEW_HZ)


def _of_keypoints(motion: Motion, s: Statistics) -> Iterator[Finding]:
    if is_no_body(motion.keypoints, motion.joints):
        yield _warn(MotionCheck.NO_BODY)
    # The median: a few gross outliers in 2D, which the method ignores, are no reason to doubt the rest.
    if (share := s.median_px / s.body_px) > _HIGH_ERROR:
        yield _warn(MotionCheck.HIGH_ERROR, px=s.median_px, share=share)
    error = motion.reprojection_px[np.isfinite(motion.reprojection_px)]
    outlying = float(np.mean(error > _OUTLYING * s.body_px)) if error.size else 0.0
    if outlying > _SOME_OUTLIERS:
        level = _warn if outlying > _MANY_OUTLIERS else _note
        yield level(MotionCheck.OUTLIERS, share=outlying, limit=_OUTLYING, rms=s.rms_px, median=s.median_px)
    yield from _of_missing_joints(motion, s)


def _of_missing_joints(motion: Motion, s: Statistics) -> Iterator[Finding]:
    joints = np.array(motion.joints)
    estimated = np.isin(joints, TOES)
    if estimated.any() and (s.missing[estimated] == 1.0).all():
        yield _note(MotionCheck.ESTIMATED_FEET)
    else:
        estimated[:] = False
    order = np.argsort(-s.missing, kind="stable")
    worst = order[(s.missing[order] > _MISSING_SHARE) & ~estimated[order]]
    if len(worst):
        named = ", ".join(f"{motion.joints[j]} {s.missing[j]:.0%}" for j in worst[:4])
        more = f" and {len(worst) - 4} more" if len(worst) > 4 else ""
        yield _warn(MotionCheck.MISSING_JOINTS, limit=_MISSING_SHARE, joints=named + more)


def _of_path(s: Statistics) -> Iterator[Finding]:
    if s.foot_m_s > max(MOTION_REST_M_S, _SLIDING_SHARE * s.pelvis_m_s):
        yield _warn(MotionCheck.SLIDING_FEET, speed=s.foot_m_s)
    if abs(s.lean_deg) > _LEANING_DEG:
        where = "away from" if s.lean_deg > 0 else "towards"
        yield _warn(MotionCheck.LEANING, lean=abs(s.lean_deg), where=where)


def _of_frame(motion: Motion) -> Iterator[Finding]:
    if motion.frame != "world":
        yield _note(MotionCheck.NO_VERTICAL)
    if not motion.metric:
        height = motion.meta.get("assumed_height_m")
        assumed = f" of {height:.2f} m" if isinstance(height, int | float) else ""
        yield _note(MotionCheck.ASSUMED_SCALE, source=motion.scale_source.replace("_", " "), height=assumed)
    if isinstance(source := motion.meta.get("telemetry"), dict) and "zoom" in source:
        yield _warn(MotionCheck.ZOOM, words=str(source["zoom"]).capitalize())
    if words := telemetry_words(motion.meta):
        if "telemetry_rejected" in motion.meta:
            yield _warn(MotionCheck.TELEMETRY_REJECTED, words=words)
        elif any(window.get("camera_jumps_m", 0.0) > 0 for window in motion.meta.get("calibration", ())):
            yield _warn(MotionCheck.TELEMETRY_JUMPS, words=words)
        else:
            yield _note(MotionCheck.CALIBRATION, words=words)
