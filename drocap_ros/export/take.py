"""A motion prepared for other formats: upright axes, a time line, marked gaps."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.geometry.interpolation import true_runs, usual_step
from drocap_ros.motion import Motion, upright_joints
from drocap_ros.tracks import MAX_FRAMES

#: Stamps within this share of a frame of an even time line count as even.
EVEN_TOLERANCE = 0.05
#: Times that differ by less than this share of a frame are the same.
_SAME_FRAME = 1e-3
#: Names that every format accepts.
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,60}")
#: glTF skins store a joint in one byte; C3D readers accept no more either.
_MAX_JOINTS = 255
#: Between two frames, or two sights of the person, further apart than this positions are unknown.
LONGEST_BRIDGE_S = 0.5


@dataclass(frozen=True)
class Take:
    """Joints over time in the axes of an export.

    positions : (F, P, 3) float64, m, NaN where unknown
    joints, parents : P names; P parent indices, -1 at the root
    times_s : (F,) s, 0 at the first frame
    rate_hz : frames per second; of an uneven time line the inverse of its usual step
    notes : sentences on changes
    """

    positions: np.ndarray
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    times_s: np.ndarray
    rate_hz: float
    notes: tuple[str, ...] = ()


def take_of(motion: Motion, *, measured: bool = False) -> Take:
    """Z-up take of a motion; with ``measured`` the positions of :func:`unseen_frames` are unknown.

    Frame "world" keeps its axes (x east, y north, z up).  Frame "camera" (x right, y down, z forward) becomes
    x right, y away from the camera, z up: its vertical is the camera's, not gravity's.
    """
    _check(motion)
    times = (motion.stamp_ns - motion.stamp_ns[0]) * 1e-9
    step = usual_step(times)
    notes = []
    if motion.frame == "camera":
        notes.append("upright as the camera saw it: its vertical is the camera's, not gravity's")
    if not motion.metric:
        notes.append(f"scale from {motion.scale_source}, not measured")
    positions, unseen = upright_joints(motion), unseen_frames(motion)
    if unseen.any():
        poses = "unknown" if measured else "interpolated, not measured"
        notes.append(f"{np.count_nonzero(unseen)} frames without the person: their poses are {poses}")
    if measured:
        positions = np.where(unseen[:, None, None], np.nan, positions)
    return Take(positions, motion.joints, motion.parents, times, 1.0 / step, notes=tuple(notes))


def _check(motion: Motion) -> None:
    frames = len(motion.joints3d)
    if frames < 2:
        raise InputError(f"motion: expected at least 2 frames to animate, got {frames}; reconstruct a longer recording")
    if not np.isfinite(motion.joints3d).all(axis=2).any():
        raise InputError("motion: expected 3D joints in at least one frame, got NaN in all of them; see its report")
    if len(motion.joints) > _MAX_JOINTS:
        raise InputError(f"joints: expected at most {_MAX_JOINTS} joints, got {len(motion.joints)}; leave some out")
    for name in motion.joints:
        if not _NAME.fullmatch(name):
            raise InputError(f"joints: expected names of letters, digits, _ . -, got {name[:60]!r}; rename the joint")


def unseen_frames(motion: Motion) -> np.ndarray:
    """(F,) bool, frames of each time longer than ``LONGEST_BRIDGE_S`` in which no joint has a confidence.

    A motion without any confidence has none.
    """
    seen = np.asarray((motion.confidence > 0.0).any(axis=1))
    unseen = np.zeros(len(seen), bool)
    if seen.any():
        for first, end in true_runs(~seen):
            span_ns = motion.stamp_ns[min(end, len(seen) - 1)] - motion.stamp_ns[max(first - 1, 0)]
            unseen[first:end] = span_ns > 1e9 * LONGEST_BRIDGE_S
    return unseen


def y_up(take: Take) -> Take:
    """The same take with y up: (x, y, z) becomes (x, z, -y)."""
    turned = take.positions[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    return replace(take, positions=turned)


def at_constant_rate(take: Take) -> Take:
    """Take on an even time line, for formats with a frame rate instead of stamps.

    An uneven time line is resampled, linearly, at the inverse of its usual step; within gaps longer than
    ``LONGEST_BRIDGE_S`` the result is NaN.
    """
    times, last = take.times_s, float(take.times_s[-1])
    even_step = last / (len(times) - 1)
    if np.abs(times - np.arange(len(times)) * even_step).max() <= EVEN_TOLERANCE * even_step:
        return replace(take, rate_hz=1.0 / even_step)
    count = int(np.floor(last * take.rate_hz + 1e-6)) + 1
    if count > MAX_FRAMES:
        raise InputError(
            f"motion: expected at most {MAX_FRAMES} frames at a constant rate, its stamps span {last:.0f} s at"
            f" {take.rate_hz:.6g} Hz; export to csv or glb, or cut the recording"
        )
    even = np.arange(count) / take.rate_hz
    right = np.clip(np.searchsorted(times, even, side="left"), 1, len(times) - 1)
    left, span = right - 1, times[right] - times[right - 1]
    share = np.clip((even - times[left]) / span, 0.0, 1.0)
    # A sample on a frame equals that frame, even where its neighbour is unknown or far.
    on_left, on_right = (np.abs(even - times[i]) * take.rate_hz < _SAME_FRAME for i in (left, right))
    share = np.where(on_left, 0.0, np.where(on_right, 1.0, share))[:, None, None]
    a, b = take.positions[left], take.positions[right]
    mixed = np.where(share <= 0, a, np.where(share >= 1, b, (1 - share) * a + share * b))
    mixed[(span > LONGEST_BRIDGE_S) & ~on_left & ~on_right] = np.nan
    note = f"uneven stamps resampled, linearly, to {take.rate_hz:.6g} Hz"
    return replace(take, positions=mixed, times_s=even, notes=(*take.notes, note))


def without_gaps(take: Take) -> Take:
    """Take with unknown joints interpolated over time, constant before the first and after the last known one."""
    known = np.isfinite(take.positions).all(axis=2)
    never = [name for name, seen in zip(take.joints, known.any(axis=0), strict=True) if not seen]
    if never:
        raise InputError(f"motion: expected every joint in at least one frame, never known: {', '.join(never)}")
    if known.all():
        return take
    filled = interpolated(take.times_s, take.positions, known)
    note = f"{np.count_nonzero(~known.all(axis=1))} frames with unknown joints interpolated over time"
    return replace(take, positions=filled, notes=(*take.notes, note))


def interpolated(times_s: np.ndarray, positions: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Positions (F, P, 3) of joints known (F, P) in part, interpolated over time; the others as they are."""
    filled: np.ndarray = positions.copy()
    for joint in np.flatnonzero(known.any(axis=0) & ~known.all(axis=0)):
        seen = known[:, joint]
        for axis in range(3):
            filled[:, joint, axis] = np.interp(times_s, times_s[seen], positions[seen, joint, axis])
    return filled
