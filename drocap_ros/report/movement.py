"""Joint angles and speeds over time for people who move: how a knee bends, how fast a hand is.

A straight leg or arm has 0 degrees of flexion; a thigh behind the trunk less.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.rotations import unpack_covariance
from drocap_ros.motion import Motion, upright_joints
from drocap_ros.report.statistics import Statistics
from drocap_ros.skeleton import indices

#: The three joints of an angle.
_CHAINS = {"knee": ("hip", "knee", "ankle"), "elbow": ("shoulder", "elbow", "wrist")}


def flexion(joints: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """(F, 2) degrees of the right and the left knee, hip and elbow; NaN where a joint is.

    joints : (F, P, 3), any unit and frame
    names : (P,) of the joints
    """
    at = dict(zip(names, np.moveaxis(joints, 1, 0), strict=True))
    indices(names, ("neck", "pelvis", *(side + name for side in "rl" for name in ("hip", *sum(_CHAINS.values(), ())))))
    return {"knee": _bend(at, "knee"), "hip": _hips(at), "elbow": _bend(at, "elbow")}


def _bend(at: dict[str, np.ndarray], joint: str) -> np.ndarray:
    sides = []
    for side in "rl":
        first, middle, last = (at[side + name] for name in _CHAINS[joint])
        upper, lower = middle - first, last - middle
        across = np.linalg.norm(np.cross(upper, lower), axis=-1)
        sides.append(np.degrees(np.arctan2(across, (upper * lower).sum(axis=-1))))
    return np.stack(sides, axis=1)


def _hips(at: dict[str, np.ndarray]) -> np.ndarray:
    """Between trunk and thigh, seen from the side: forwards is positive."""
    trunk = at["neck"] - at["pelvis"]
    forwards = np.cross(at["lhip"] - at["rhip"], trunk)
    up = np.cross(forwards, at["lhip"] - at["rhip"])
    scale = np.linalg.norm(up, axis=-1) / np.maximum(np.linalg.norm(forwards, axis=-1), 1e-12)
    sides = []
    for side in "rl":
        thigh = at[side + "knee"] - at[side + "hip"]
        ahead = (thigh * forwards).sum(axis=-1) * scale
        # No thigh points backwards by a right angle: the cut lies there.
        sides.append(np.degrees((np.arctan2(ahead, -(thigh * up).sum(axis=-1)) + 0.5 * np.pi) % (2 * np.pi)) - 90.0)
    return np.stack(sides, axis=1)


def flexion_words(joints: np.ndarray, names: tuple[str, ...]) -> str:
    """Medians over the frames, right and left, in words; empty without the joints' names or values."""
    try:
        angles = flexion(joints, names)
    except InputError:
        return ""
    known = {joint: angle[np.isfinite(angle).all(axis=1)] for joint, angle in angles.items()}
    if not all(len(angle) for angle in known.values()):
        return ""
    medians = {joint: np.median(angle, axis=0) for joint, angle in known.items()}
    return ", ".join(f"{joint}s {both[0]:.0f} and {both[1]:.0f}" for joint, both in medians.items()) + " degrees"


#: Step of numerical derivatives, m: small beside a bone, large beside the rounding of doubles.
_STEP_M = 1e-4
_ANGLES = {
    "knee": "0° is a straight leg.",
    "hip": "Thigh against the trunk, seen from the side: 0° is standing, forwards is positive.",
    "elbow": "0° is a straight arm.",
}
_BOTH = ("right", "left")


@dataclass(frozen=True)
class Curve:
    """One chart: a quantity of both sides or of the middle, at the frames asked for.

    name, unit, words : title, unit of the values, one sentence on how to read it
    sides : N of "right", "left", "middle"
    values : (F, N), NaN where unknown
    deviation : (F, N) standard deviation of the values, by the motion's covariances; None = not known
    """

    name: str
    unit: str
    words: str
    sides: tuple[str, ...]
    values: np.ndarray
    deviation: np.ndarray | None = None


def movement(motion: Motion, s: Statistics, frames: np.ndarray) -> list[Curve]:
    """Bends of knees, hips and elbows, speeds of pelvis, wrists and ankles, at frames (N,) by index.

    What the motion has no joints for is left out.  Frames without the person are unknown, as their poses are
    interpolated.
    """
    curves = [*_angles(motion, frames), *_speeds(motion, s, frames)]
    if s.seen.any():
        for curve in curves:
            curve.values[~s.seen[frames]] = np.nan
    return curves


def _angles(motion: Motion, frames: np.ndarray) -> Iterator[Curve]:
    joints = upright_joints(motion)[frames]
    try:
        angles = flexion(joints, motion.joints)
    except InputError:
        return
    deviations = bend_deviations(motion, frames)
    for joint, words in _ANGLES.items():
        yield Curve(f"{joint.capitalize()} bend", "°", words, _BOTH, angles[joint], deviations.get(joint))


def bend_deviations(motion: Motion, frames: np.ndarray | slice = slice(None)) -> dict[str, np.ndarray]:
    """Knee, hip, elbow -> (N, 2) deg, standard deviations of the bends, right and left; nothing where unknown."""
    covariance = _about_pelvis(motion, frames)
    return {} if covariance is None else _deviations(upright_joints(motion)[frames], motion.joints, covariance)


def _about_pelvis(motion: Motion, frames: np.ndarray | slice) -> np.ndarray | None:
    """(F, P, 3, 3) m^2 of joints about the pelvis: an error that all joints share turns no limb."""
    if motion.covariance is None or "pelvis" not in motion.joints:
        return None
    covariance = unpack_covariance(motion.covariance[frames])
    if motion.meta.get("covariance_about") == "pelvis":
        return covariance
    relative = np.nan_to_num(covariance - covariance[:, [motion.joints.index("pelvis")]])
    variances, axes = np.linalg.eigh(relative)
    return np.asarray((axes * np.maximum(variances, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _deviations(joints: np.ndarray, names: tuple[str, ...], covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Joint -> (F, 2) deg, to first order, the errors of joints independent."""
    at = flexion(joints, names)
    variance = {joint: np.zeros_like(angle) for joint, angle in at.items()}
    for place in range(len(names)):
        slopes = []
        for axis in range(3):
            moved = joints.copy()
            moved[:, place, axis] += _STEP_M
            slopes.append({joint: (angle - at[joint]) / _STEP_M for joint, angle in flexion(moved, names).items()})
        for joint in variance:
            slope = np.stack([by_axis[joint] for by_axis in slopes], axis=-1)
            variance[joint] += np.einsum("fsi,fij,fsj->fs", slope, covariance[:, place], slope)
    return {joint: np.sqrt(value) for joint, value in variance.items()}


def _speeds(motion: Motion, s: Statistics, frames: np.ndarray) -> Iterator[Curve]:
    if len(motion.stamp_ns) < 3:
        return
    joints = upright_joints(motion)
    pelvis = joints[:, [motion.joints.index("pelvis")]]
    path_known = motion.frame == "world" and bool(np.ptp(pelvis[np.isfinite(pelvis).all(axis=(1, 2))], axis=0).any())
    half = _half_window(s.times_s)
    mean = f"mean over {2 * half * float(np.median(np.diff(s.times_s))):.1g} s"
    words = f"Through the world, {mean}."
    if not path_known:
        words = f"Against the pelvis, whose path is not known, in axes that turn with the body; {mean}."
        joints = _facing(joints - pelvis, s.heading_rad)
    if path_known:
        yield Curve("Pelvis speed", "m/s", words, ("middle",), _speed(pelvis, s.times_s, frames))
    for joint in ("wrist", "ankle"):
        ends = [side + joint for side in "rl"]
        if set(ends) <= set(motion.joints):
            both = joints[:, [motion.joints.index(end) for end in ends]]
            yield Curve(f"{joint.capitalize()} speed", "m/s", words, _BOTH, _speed(both, s.times_s, frames))


def _facing(joints: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """(F, P, 3) in axes turned about the vertical by the heading (F,) rad."""
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    x, y, z = np.moveaxis(joints, -1, 0)
    return np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=-1)


def _half_window(times_s: np.ndarray) -> int:
    """Frames before and after each that a speed counts, at least one."""
    # Half the time of a speed's mean, s: at walking a hand or foot hardly turns in it, and noise of one image is
    # halved.
    return min(max(1, round(0.1 / float(np.median(np.diff(times_s))))), (len(times_s) - 1) // 2)


def _speed(joints: np.ndarray, times_s: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(N, P) m/s at frames (N,): length of the slope of the line through the places (F, P, 3) around each."""
    half = _half_window(times_s)
    window = np.clip(frames - half, 0, len(times_s) - 1 - 2 * half)[:, None] + np.arange(2 * half + 1)
    since = times_s[window] - times_s[window].mean(axis=1, keepdims=True)
    slope = np.einsum("nw,nwpi->npi", since, joints[window]) / np.square(since).sum(axis=1)[:, None, None]
    return np.asarray(np.linalg.norm(slope, axis=-1))
