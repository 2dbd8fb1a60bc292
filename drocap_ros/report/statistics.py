"""Statistics of a motion without a ground truth: the numbers behind the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.contacts import speed_of_lowest
from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import directions, torso_frame
from drocap_ros.geometry.interpolation import usual_step
from drocap_ros.motion import Motion, upright_camera_rotation, upright_joints
from drocap_ros.skeleton import RIGID_BONES, JointSet, indices

#: Directions of view and of the body, and places without a world, are averaged over this time, s.
SMOOTH_S = 0.5
_TORSO = ("pelvis", "neck", "lhip", "rhip", "lshoulder", "rshoulder")


@dataclass(frozen=True)
class Statistics:
    """Statistics of one motion of F frames, P joints, B rigid bones; NaN where nothing is known.

    Poses of frames without any keypoint are interpolated: none of these statistics counts them, except in a motion
    without any keypoints.

    times_s : (F,) s since the first frame
    seen : (F,) bool, any keypoint found
    missing : (P,) share of frames without the joint's keypoint
    error_px : (F,) root mean square over joints of the reprojection error
    joint_error_px : (P,) the same over frames
    rms_px, median_px : reprojection error of all joints in all frames
    body_px : median diagonal of the keypoints' bounding box, at least 1
    bones, bone_lengths_m : B names; (F, B) lengths
    bone_spread : (B,) standard deviation over mean of each bone's length
    view_deg : (F,) azimuth of the camera from the body (0 in front, positive to its left), unwrapped; NaN where
        interpolated
    view_speed_dps, view_span_deg : median speed and range of that
    elevation_deg : median elevation of the camera above the body: above the horizon where the vertical is known, else
        above the plane across the trunk
    lean_deg : angle by which an upright body leans away from the camera, from whatever side it sees it; NaN where the
        vertical is not known, the body is rarely upright, or the camera looks from less than about half a turn
    heading_rad : (F,) direction that the body faces, about the vertical; in interpolated frames too
    knees_forward : share of bent knees that bend forward; NaN where none is bent
    bent_knees : number of bent knees
    foot_m_s : median speed of the lower ankle in the half of the frames in which it is lowest; of a person that stands
        or walks it is near 0.  NaN where the path in the world is not known
    pelvis_m_s : median horizontal speed of the pelvis, NaN likewise
    """

    times_s: np.ndarray
    seen: np.ndarray
    missing: np.ndarray
    error_px: np.ndarray
    joint_error_px: np.ndarray
    rms_px: float
    median_px: float
    body_px: float
    bones: tuple[str, ...]
    bone_lengths_m: np.ndarray
    bone_spread: np.ndarray
    view_deg: np.ndarray
    view_speed_dps: float
    view_span_deg: float
    elevation_deg: float
    lean_deg: float
    heading_rad: np.ndarray
    knees_forward: float
    bent_knees: int
    foot_m_s: float
    pelvis_m_s: float

    @property
    def rate_hz(self) -> float:
        """Frames per second, by the usual step; 0 for a single frame."""
        return 1.0 / usual_step(self.times_s) if len(self.times_s) > 1 else 0.0


def motion_statistics(motion: Motion) -> Statistics:
    """Statistics of a motion."""
    indices(motion.joints, _TORSO)
    if not np.isfinite(motion.joints3d).all(axis=2).any():
        raise InputError(
            "motion: expected 3D joints in at least one frame, got NaN in all of them; check that the person is in view"
        )
    times = (motion.stamp_ns - motion.stamp_ns[0]) * 1e-9
    found = np.isfinite(motion.keypoints).all(axis=2)
    square = np.square(motion.reprojection_px)
    joints = upright_joints(motion)
    torso = _torso(joints, motion)
    seen = found.any(axis=1)
    counted = seen if seen.any() else np.ones_like(seen)
    view = _view_azimuth(torso, upright_camera_rotation(motion)[:, 2], times)
    speed = (np.abs(np.gradient(view, times)) if len(times) > 1 else np.zeros(1))[counted]
    elevation = _elevation(motion, torso[counted], upright_camera_rotation(motion)[counted, 2])
    heading = _heading(torso, times)
    motion = replace(motion, joints3d=np.where(counted[:, None, None], motion.joints3d, np.nan))
    joints = upright_joints(motion)
    bones, lengths = _bones(joints, motion)
    forward, judged = _knees(joints, motion, torso[..., 0])
    foot, pelvis = _path_speeds(motion, times)
    return Statistics(
        times_s=times,
        seen=seen,
        missing=1.0 - found.mean(axis=0),
        error_px=np.sqrt(mean_known(square, 1)),
        joint_error_px=np.sqrt(mean_known(square, 0)),
        rms_px=float(np.sqrt(mean_known(square, None))),
        median_px=_median(motion.reprojection_px),
        body_px=_body_size(motion.keypoints),
        bones=bones,
        bone_lengths_m=lengths,
        bone_spread=_spread(lengths),
        view_deg=np.degrees(np.where(counted, view, np.nan)),
        view_speed_dps=float(np.degrees(np.median(speed))),
        view_span_deg=float(np.degrees(np.ptp(view[counted]))),
        elevation_deg=elevation,
        lean_deg=_lean(motion),
        heading_rad=heading,
        knees_forward=forward,
        bent_knees=judged,
        foot_m_s=foot,
        pelvis_m_s=pelvis,
    )


def scale_of(motion: Motion) -> tuple[str, str]:
    """Whether metres are measured or assumed, and from what, in words."""
    return "measured" if motion.metric else "assumed", f"from {motion.scale_source.replace('_', ' ')}"


def stage_seconds(meta: Mapping[str, object]) -> dict[str, float]:
    """Seconds per stage of a motion's ``meta`` in the order of the stages, the total last; others are left out."""
    seconds = meta.get("seconds")
    if not isinstance(seconds, dict):
        return {}
    first, last = ("pose2d", "initial", "ba"), ("other", "total")
    order = [*first, *sorted(seconds.keys() - {*first, *last}), *last]
    return {k: float(seconds[k]) for k in order if isinstance(seconds.get(k), int | float)}


def mean_known(values: np.ndarray, axis: int | None) -> np.ndarray:
    """Mean over the values that are not NaN; NaN where there are none."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def smooth(values: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Moving average over ``SMOOTH_S`` along the first axis; shorter at the ends."""
    if len(values) < 2:
        return values
    half = max(1, round(0.5 * SMOOTH_S / float(np.median(np.diff(times_s)))))
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    at = np.arange(len(values))
    first, last = np.maximum(at - half, 0), np.minimum(at + half + 1, len(values))
    return np.asarray((total[last] - total[first]) / (last - first).reshape(-1, *[1] * (values.ndim - 1)))


def _torso(joints: np.ndarray, motion: Motion) -> np.ndarray:
    """(F, 3, 3), columns forward, left, up; frames without a torso take the nearest one before or after."""
    use = indices(motion.joints, _TORSO)
    known = np.isfinite(joints[:, use]).all(axis=(1, 2))
    if not known.any():
        return np.tile(np.eye(3), (len(joints), 1, 1))
    last = np.maximum.accumulate(np.where(known, np.arange(len(joints)), -1))
    nearest = np.where(last >= 0, last, np.flatnonzero(known)[0])
    return torso_frame(joints[nearest], JointSet("motion", motion.joints, motion.parents))


def _view_azimuth(torso: np.ndarray, forward: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    to_camera = -np.einsum("fij,fi->fj", torso, forward)
    to_camera = smooth(to_camera, times_s)
    return np.unwrap(np.arctan2(to_camera[:, 1], to_camera[:, 0]))


def _elevation(motion: Motion, torso: np.ndarray, forward: np.ndarray) -> float:
    up = -forward[:, 2] if motion.frame == "world" else -np.einsum("fi,fi->f", torso[..., 2], forward)
    return float(np.degrees(np.arcsin(np.clip(np.median(up), -1.0, 1.0))))


def _lean(motion: Motion) -> float:
    """Lean from the ankles to the neck, of its part that turns with the camera's bearing."""
    ends = ("neck", "lankle", "rankle")
    if motion.frame != "world" or not set(ends) <= set(motion.joints):
        return float("nan")
    neck, left, right = (motion.joints3d[:, i] for i in indices(motion.joints, ends))
    body, bearing = neck - 0.5 * (left + right), motion.camera_rotation[:, 2, :2]
    length, flat = np.linalg.norm(body, axis=1), np.linalg.norm(bearing, axis=1)
    # A body is upright whose neck is 0.7 of its length above the ankles: one who lies leans anyhow.
    upright = (body[:, 2] > 0.7 * length) & (length > 0) & (flat > 0)
    if upright.sum() <= 0.5 * np.isfinite(length).sum():
        return float("nan")
    lean, away = body[upright, :2] / length[upright, None], bearing[upright] / flat[upright, None]
    lean, away = lean - lean.mean(axis=0), away - away.mean(axis=0)
    spread = float(np.square(away).sum(axis=1).mean())
    # Spread of the camera's bearings (mean square about the mean of unit vectors) of half a turn: 0.6; of a whole one:
    # 1.
    if spread < 0.5:
        return float("nan")
    sine = float((lean * away).sum(axis=1).mean()) / spread
    return float(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))


def _heading(torso: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    # Left, not forward: a body that bends forward keeps its left.
    left = smooth(torso[..., 1], times_s)
    return np.unwrap(np.arctan2(-left[:, 0], left[:, 1]))


def _bones(joints: np.ndarray, motion: Motion) -> tuple[tuple[str, ...], np.ndarray]:
    here = [(a, b) for a, b in RIGID_BONES if a in motion.joints and b in motion.joints]
    ends = np.array([indices(motion.joints, bone) for bone in here])
    lengths = np.linalg.norm(joints[:, ends[:, 1]] - joints[:, ends[:, 0]], axis=2)
    return tuple(f"{a} - {b}" for a, b in here), lengths


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _spread(lengths: np.ndarray) -> np.ndarray:
    """(B,) standard deviation over mean of lengths (F, B)."""
    mean = mean_known(lengths, 0)
    deviation = np.sqrt(mean_known(np.square(lengths - mean), 0))
    return np.where(mean > 0, deviation / np.where(mean > 0, mean, 1.0), np.nan)


def _body_size(keypoints: np.ndarray) -> float:
    found = np.isfinite(keypoints).all(axis=2)
    enough = found.sum(axis=1) >= 4
    if not enough.any():
        return float("nan")
    points, known = keypoints[enough], found[enough][..., None]
    high = np.where(known, points, -np.inf).max(axis=1)
    low = np.where(known, points, np.inf).min(axis=1)
    return max(float(np.median(np.linalg.norm(high - low, axis=1))), 1.0)


def _knees(joints: np.ndarray, motion: Motion, forward: np.ndarray) -> tuple[float, int]:
    """Share of bent knees that bend forward, and how many were bent."""
    bent = ahead = 0
    for side in "lr":
        if not {f"{side}hip", f"{side}knee", f"{side}ankle"} <= set(motion.joints):
            continue
        hip, knee, ankle = np.moveaxis(
            joints[:, indices(motion.joints, (f"{side}hip", f"{side}knee", f"{side}ankle"))], 1, 0
        )
        thigh, shank = directions(knee - hip), directions(ankle - knee)
        # The knee lies off the line from hip to ankle, in the direction of thigh minus shank.
        # A knee counts as bent from this angle, degrees, on; below it the direction of the bend is noise.
        judged = np.degrees(np.arccos(np.clip(np.sum(thigh * shank, axis=1), -1.0, 1.0))) > 25.0
        bent += int(judged.sum())
        ahead += int((np.sum((thigh - shank) * forward, axis=1)[judged] > 0).sum())
    return (ahead / bent if bent else float("nan")), bent


def _path_speeds(motion: Motion, times_s: np.ndarray) -> tuple[float, float]:
    """``foot_m_s`` and ``pelvis_m_s`` of :class:`Statistics`."""
    ankles = ("rankle", "lankle")
    if motion.frame != "world" or len(times_s) < 2 or not set(ankles) <= set(motion.joints):
        return float("nan"), float("nan")
    use = indices(motion.joints, ("pelvis", *ankles))
    at = motion.joints3d[:, use]
    at, times_s = at[(known := np.isfinite(at).all(axis=(1, 2)))], times_s[known]
    # Without the camera's position the pelvis stays at the origin.
    if len(at) < 2 or not np.ptp(at[:, 0], axis=0).any():
        return float("nan"), float("nan")
    step_s = np.diff(times_s)
    pelvis = np.linalg.norm(np.diff(at[:, 0, :2], axis=0) / step_s[:, None], axis=1)
    return speed_of_lowest(at[:, 1:], step_s), float(np.median(pelvis))
