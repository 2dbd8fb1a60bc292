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


class Severity(Enum):
    """Consequence of a finding: doubt the motion, or read it with care."""

    WARNING = "warning"
    NOTE = "note"


class MotionCheck(Enum):
    """The checks, in the order of the report: a title, one to three sentences with places for the values, limits.

    Limits are judgements, unless a reason stands beside them; of two of one kind the first is noted, the second warned
    of.
    """

    MISSING_POSES = (
        "Frames without a pose",
        "{missing} of {frames} frames have no 3D pose. They are empty here and gaps in every export.",
    )
    MIRRORED = (
        "Possibly mirrored in depth",
        "{backward:.0%} of the {bent} bent knees bend backward. A body mirrored in depth fits the image equally well;"
        " compare with the video from the side, and check that left and right were not exchanged in 2D.",
        # Share of forward knees, no likelier right than mirrored; least number of bent ones.
        (0.5, 10),
    )
    MISFIT = (
        "Recordings do not fit",
        "Half of the keypoints of {name} lie more than {px:.1f} px from the body that fits all recordings, {alone:.1f}"
        " from its own. They may show another person or another time; look at both from the same side.",
        (2.0,),  # distance from the common body over that from their own: right pairs have up to 1.9
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
        # Degrees per second, below which the paper's study gains little; degrees: more than a second of its orbit.
        (10.0, 30.0),
    )
    STEEP_VIEW = (
        "Steep view",
        "The camera looks at the body from {elevation:.0f}° above (median). Limbs are foreshortened and hide each"
        " other, so the joints err more. Fly lower or farther away; below {limit:.0f}° the view does not limit the"
        " result.",
        # Degrees: from the first on the error grows by a fifth, at the second it nearly doubles.
        (45.0, 60.0),
    )
    LOW_RATE = (
        "Low image rate",
        "{rate:.1f} images per second. Fast motions fall between, so joints err more. Record at {limit:.0f} or more.",
        # Images per second: below the first errors grow, at the second by half, at 5 threefold.
        (20.0, 12.5),
    )
    GAP = (
        "Gap in time",
        "No image for {gap:.0f} s after {at:.1f} s: these are two recordings. Cut there: `--start`, `--end`.",
        (5.0,),  # s
    )
    HIGH_ERROR = (
        "High reprojection error",
        "Half of the joints project more than {px:.1f} px from their keypoints, {share:.1%} of the body's size in the"
        " image. The 2D keypoints are noisy, or the motion does not explain them.",
        (0.02,),  # share of the body's size in the image, of the median
    )
    NO_BODY = (
        "Keypoints of no body",
        "By their places in the image the keypoints are not those of a person with these names: joints are exchanged,"
        " of another order, or upside down. Check the names; `drocap reconstruct --order NAME` replaces them. A body"
        " that is seen from steeply above may look like that too.",
    )
    OUTLIERS = (
        "Outlying keypoints",
        "{share:.1%} of the keypoints lie more than {limit:.0%} of the body's size from the projected joints. They"
        " raise the RMS ({rms:.1f} px) far above the median ({median:.1f} px).",
        # Shares of keypoints, of which the method ignores few; share of the body's size from which one is outlying.
        (0.01, 0.1, 0.08),
    )
    SLIDING_FEET = (
        "Sliding feet",
        "The lower foot moves at {speed:.2f} m/s (median); the foot of a person that walks or stands rests. The path,"
        " the scale or the depths are wrong, or the person glides.",
        # Share of the pelvis's speed: the lower foot of no take of 523 with real walks, runs, jumps and squats exceeds
        # the larger of it and of ``MOTION_REST_M_S``.
        (0.3,),
    )
    LEANING = (
        "Body leans with the camera",
        "From every side the body leans {lean:.0f}° {where} the camera. The camera's reported pitch is wrong by about"
        " as much, and so is the body's place: check the pitch of the mount and its sign, negative = down.",
        # Degrees: 64 true takes, seen from an orbit, reach 3.6; a mount's pitch off by 10 gives 10.
        (8.0,),
    )
    MISSING_JOINTS = (
        "Many missing joints",
        "Keypoints missing in more than {limit:.0%} of the frames: {joints}. Their 3D is filled in.",
        (0.1,),  # share of the frames
    )
    ESTIMATED_FEET = (
        "Feet estimated",
        "The 2D network shows no toes: their 3D is the lifter's estimate. A network of 26 or 133 joints shows them.",
    )
    SHORT = (
        "Short sequence",
        "Frames: {frames}, over {seconds:.1f} s. Joint adjustment needs many views of a motion; such a result is close"
        " to single-view estimation.",
        (30, 2.0),  # frames and seconds: with fewer there are few views to join
    )
    BONE_LENGTHS = (
        "Bones change their length",
        "{bone} varies by {worst:.0%} (standard deviation), all by {mean:.0%} on average. No method fixes bone lengths"
        " exactly; BVH export does.",
        (0.1,),  # standard deviation over the mean
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

    def __init__(self, title: str, words: str, limits: tuple[float, ...] = ()) -> None:
        self.title, self.words, self.limits = title, words, limits


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
        return self.check.title if self.person is None else f"Person {self.person}: {self.check.title}"

    @property
    def text(self) -> str:
        """One to three sentences."""
        return self.check.words.format(**self.values)


#: Checks that alone make a motion doubtful.
_DOUBTFUL = (
    MotionCheck.GAP,
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
    # So many warnings make a motion doubtful; a judgement.
    doubtful = len(warnings) >= 3 or any(w.check in _DOUBTFUL for w in warnings)
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
    share, least = MotionCheck.MIRRORED.limits
    if s.bent_knees >= least and s.knees_forward <= share:
        yield _warn(MotionCheck.MIRRORED, backward=1.0 - s.knees_forward, bent=s.bent_knees)
    if (np.array([frames, seconds]) < MotionCheck.SHORT.limits).any():
        yield _warn(MotionCheck.SHORT, frames=frames, seconds=seconds)
    if frames > 1 and np.nanmax(s.bone_spread, initial=0.0) > MotionCheck.BONE_LENGTHS.limits[0]:
        worst = int(np.nanargmax(s.bone_spread))
        mean = float(mean_known(s.bone_spread, None))
        yield _note(MotionCheck.BONE_LENGTHS, bone=s.bones[worst], worst=float(s.bone_spread[worst]), mean=mean)


def _of_view(motion: Motion, s: Statistics) -> Iterator[Finding]:
    views = motion.meta.get("together", {}).get("views", ())
    for view in views:
        if view["misfit"] > MotionCheck.MISFIT.limits[0]:
            values = {"px": view["median_px"], "alone": view["median_px_alone"]}
            yield _warn(MotionCheck.MISFIT, name=view["name"], **values)
    seen = np.array([s.view_speed_dps, s.view_span_deg])
    if not views and not (seen >= MotionCheck.LOW_CAMERA_MOTION.limits).all():
        stands = motion.meta.get("camera", {}).get("kind") == "stands"
        check = MotionCheck.ONE_VIEW if stands else MotionCheck.LOW_CAMERA_MOTION
        yield _warn(check, span=s.view_span_deg, speed=s.view_speed_dps)
    high, steep = MotionCheck.STEEP_VIEW.limits
    if s.elevation_deg > high:
        level = _warn if s.elevation_deg > steep else _note
        yield level(MotionCheck.STEEP_VIEW, elevation=s.elevation_deg, limit=high)
    gaps = np.append(np.diff(s.times_s), 0.0)
    if (gap := float(gaps.max())) > MotionCheck.GAP.limits[0]:
        yield _warn(MotionCheck.GAP, gap=gap, at=float(s.times_s[gaps.argmax()]))
    few, low = MotionCheck.LOW_RATE.limits
    if 0.0 < s.rate_hz < few:
        level = _warn if s.rate_hz < low else _note
        yield level(MotionCheck.LOW_RATE, rate=s.rate_hz, limit=few)


def _of_keypoints(motion: Motion, s: Statistics) -> Iterator[Finding]:
    # Our own networks name their joints; from 60 degrees above every second body looks as one of another order.
    if "pose2d" not in motion.meta and is_no_body(motion.keypoints, motion.joints):
        yield _warn(MotionCheck.NO_BODY)
    # The median: a few gross outliers in 2D, which the method ignores, are no reason to doubt the rest.
    if (share := s.median_px / s.body_px) > MotionCheck.HIGH_ERROR.limits[0]:
        yield _warn(MotionCheck.HIGH_ERROR, px=s.median_px, share=share)
    error = motion.reprojection_px[np.isfinite(motion.reprojection_px)]
    some, many, off = MotionCheck.OUTLIERS.limits
    outlying = float(np.mean(error > off * s.body_px)) if error.size else 0.0
    if outlying > some:
        level = _warn if outlying > many else _note
        yield level(MotionCheck.OUTLIERS, share=outlying, limit=off, rms=s.rms_px, median=s.median_px)
    yield from _of_missing_joints(motion, s)


def _of_missing_joints(motion: Motion, s: Statistics) -> Iterator[Finding]:
    joints = np.array(motion.joints)
    estimated = np.isin(joints, TOES)
    if estimated.any() and (s.missing[estimated] == 1.0).all():
        yield _note(MotionCheck.ESTIMATED_FEET)
    else:
        estimated[:] = False
    order, limit = np.argsort(-s.missing, kind="stable"), MotionCheck.MISSING_JOINTS.limits[0]
    worst = order[(s.missing[order] > limit) & ~estimated[order]]
    if len(worst):
        named = ", ".join(f"{motion.joints[j]} {s.missing[j]:.0%}" for j in worst[:4])
        more = f" and {len(worst) - 4} more" if len(worst) > 4 else ""
        yield _warn(MotionCheck.MISSING_JOINTS, limit=limit, joints=named + more)


def _of_path(s: Statistics) -> Iterator[Finding]:
    if s.foot_m_s > max(MOTION_REST_M_S, MotionCheck.SLIDING_FEET.limits[0] * s.pelvis_m_s):
        yield _warn(MotionCheck.SLIDING_FEET, speed=s.foot_m_s)
    if abs(s.lean_deg) > MotionCheck.LEANING.limits[0]:
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
