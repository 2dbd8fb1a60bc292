"""A motion prepared for other formats: upright axes, a time line, marked gaps; smoothed, feet locked on request."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, filtfilt

from drocap_ros.contacts import SHORTEST_SPAN_S, SPAN_AVERAGE_S, rest_spans
from drocap_ros.errors import InputError
from drocap_ros.geometry.alignment import directions
from drocap_ros.geometry.interpolation import true_runs, usual_step
from drocap_ros.motion import Motion, upright_joints
from drocap_ros.skeleton import indices
from drocap_ros.tracks import MAX_FRAMES

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
    # Stamps within this share of a frame of an even time line count as even.
    if np.abs(times - np.arange(len(times)) * even_step).max() <= 0.05 * even_step:
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
    # Times that differ by less than this share of a frame are the same.
    on_left, on_right = (np.abs(even - times[i]) * take.rate_hz < 1e-3 for i in (left, right))
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


#: A filter of order 2 applied twice has its -3 dB at this share of its cut-off.
_TWICE = (np.sqrt(2.0) - 1.0) ** 0.25
#: Farther than this, m, from its median place a foot is not at rest.
_FARTHEST_M = 0.08
#: A root that moves less than this stands still: it has no place in the world, m.
ROOT_MOVES_M = 0.05


def smooth(take: Take, cut_off_hz: float) -> Take:
    """Take filtered by a zero-phase Butterworth filter of order 4: order 2, both ways (Winter 2009, 3.4.4).

    Unknown joints stay unknown; the filter passes over them by linear interpolation.  An uneven time line is resampled.
    """
    take = at_constant_rate(take)
    corrected = cut_off_hz / _TWICE
    if not 0.0 < corrected < 0.5 * take.rate_hz:
        most = 0.5 * take.rate_hz * _TWICE
        raise InputError(f"smooth: expected a cut-off between 0 and {most:.3g}, got {cut_off_hz:g} Hz; choose another")
    b, a = butter(2, corrected, fs=take.rate_hz)
    out = take.positions
    if len(out) <= 3 * max(len(a), len(b)):
        raise InputError(f"smooth: expected more than 9 frames to filter, got {len(out)}; leave it out")
    known = np.isfinite(out).all(axis=2)
    out = filtfilt(b, a, interpolated(take.times_s, out, known), axis=0)
    out = np.where(known[..., None], out, take.positions)
    note = f"smoothed (Butterworth, zero phase, order 4, {cut_off_hz:g} Hz): {_moved(take.positions, out)}"
    return replace(take, positions=out, notes=(*take.notes, note))


def lock_feet(take: Take) -> Take:
    """Take, z up, whose resting feet keep their place; knees follow by two-bone inverse kinematics.

    A foot rests while its ankle is slower than 0.4 m/s for at least 0.2 s; its place is the median over that time.
    Hips stay, thigh and shank keep the frame's lengths, toes move with the ankle.  An uneven time line is resampled.
    """
    pelvis = take.positions[:, indices(take.joints, ("pelvis",))[0]]
    pelvis = pelvis[np.isfinite(pelvis).all(axis=1)]
    if not len(pelvis) or np.ptp(pelvis, axis=0).max() < ROOT_MOVES_M:
        raise InputError(
            "lock-feet: expected a root that moves through the world, it stands still; reconstruct with telemetry"
        )
    take = at_constant_rate(take)
    out = take.positions.copy()
    before, after, count = [], [], 0
    for side in "rl":
        hip, knee, ankle = indices(take.joints, tuple(side + name for name in ("hip", "knee", "ankle")))
        rests = rest_spans(take.positions[:, ankle], take.rate_hz)
        moved = take.positions[:, ankle] + _offsets(take.positions[:, ankle], rests, take.rate_hz)
        out[:, knee], out[:, ankle] = _two_bones(take.positions[:, [hip, knee, ankle]], moved, take.rate_hz)
        if side + "toe" in take.joints:
            toe = take.joints.index(side + "toe")
            out[:, toe] += out[:, ankle] - take.positions[:, ankle]
        for first, last in rests:
            speeds = [np.diff(x[first:last, ankle], axis=0) * take.rate_hz for x in (take.positions, out)]
            before.append(np.linalg.norm(speeds[0], axis=1))
            after.append(np.linalg.norm(speeds[1], axis=1))
        count += len(rests)
    if not count:
        return replace(take, notes=(*take.notes, "feet not locked: none rests"))
    note = (
        f"feet locked in {count} rests, their speed {np.nanmean(np.concatenate(before)):.2f} ->"
        f" {np.nanmean(np.concatenate(after)):.2f} m/s: {_moved(take.positions, out)}"
    )
    return replace(take, positions=out, notes=(*take.notes, note))


def _moved(before: np.ndarray, after: np.ndarray) -> str:
    off = 1000.0 * np.linalg.norm(after - before, axis=2)
    return f"joints moved by {np.nanmean(off):.1f} mm on average, at most {np.nanmax(off):.1f} mm"


def _offsets(ankle: np.ndarray, rests: list[tuple[int, int]], rate_hz: float) -> np.ndarray:
    """(F, 3) from the ankle to its place: whole at rest, fading before and after."""
    out = np.zeros_like(ankle)
    resting = np.zeros(len(ankle), bool)
    for first, last in rests:
        resting[first:last] = True
    fade = max(round(SHORTEST_SPAN_S * rate_hz), 1)
    ramp = 0.5 * (1.0 + np.cos(np.pi * np.arange(1, fade) / fade))
    for first, last in rests:
        away = np.median(ankle[first:last], axis=0) - ankle[first:last]
        far = np.linalg.norm(away, axis=1, keepdims=True)
        away *= np.minimum(1.0, _FARTHEST_M / np.maximum(far, 1e-9))
        out[first:last] = away
        for frame, edge, step in ((first, away[0], -1), (last - 1, away[-1], 1)):
            at = frame + step * np.arange(1, fade)
            inside = (at >= 0) & (at < len(ankle))
            inside[inside] = ~resting[at[inside]]
            out[at[inside]] += ramp[inside, None] * edge
    return out


def _two_bones(leg: np.ndarray, target: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Knee and ankle (F, 3) of hip, knee, ankle (F, 3, 3) with the ankle near ``target``.

    A nearly straight leg changes its length little even by a large turn of the knee.  The damping gives up a part of
    the way there: the knee moves at most a few times as far as the ankle.
    """
    hip, knee, ankle = np.swapaxes(leg, 0, 1)
    thigh, shank = np.linalg.norm(knee - hip, axis=1), np.linalg.norm(ankle - knee, axis=1)
    before, wanted = np.linalg.norm(ankle - hip, axis=1), np.linalg.norm(target - hip, axis=1)
    both = np.maximum(thigh * shank, 1e-9)

    def flexion(reach: np.ndarray) -> np.ndarray:
        return np.asarray(np.arccos(np.clip((reach**2 - thigh**2 - shank**2) / (2.0 * both), -1.0, 1.0)))

    def reach_at(bend: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(np.maximum(thigh**2 + shank**2 + 2.0 * both * np.cos(bend), 1e-12)))

    bend = flexion(before)
    turn = flexion(wanted) - bend
    turn = np.where(np.abs(turn) < 1e-6, 1e-6, turn)
    # Change of length per turn, of the leg's half length.
    effect = 2.0 * np.abs(reach_at(bend + turn) - before) / (np.abs(turn) * np.maximum(thigh + shank, 1e-9))
    # Half of the turn is made where a turn of the knee changes the leg's half length by 0.07: at 8 degrees.
    reach = reach_at(bend + turn * effect**2 / (effect**2 + 0.07**2))
    along = (target - hip) / np.maximum(wanted, 1e-9)[:, None]
    foot = (thigh**2 - shank**2 + reach**2) / (2.0 * np.maximum(reach, 1e-9))
    height = np.sqrt(np.maximum(thigh**2 - foot**2, 0.0))
    aside = _aside(knee - hip, ankle - hip, rate_hz)
    aside = directions(aside - along * np.sum(aside * along, axis=1, keepdims=True))
    moved = np.any(target != ankle, axis=1)[:, None]
    new_knee = hip + along * foot[:, None] + aside * height[:, None]
    return np.where(moved, new_knee, knee), np.where(moved, hip + along * reach[:, None], ankle)


def _aside(knee: np.ndarray, ankle: np.ndarray, rate_hz: float) -> np.ndarray:
    """(F, 3) direction in which a knee leaves the line from hip to ankle, both (F, 3) from the hip.

    Of a straight leg it is chance: there the bent knees of the moments around count.
    """
    line = directions(ankle)
    own = knee - line * np.sum(knee * line, axis=1, keepdims=True)
    around = np.nan_to_num(own) * np.linalg.norm(np.nan_to_num(own), axis=1, keepdims=True)
    around = gaussian_filter1d(around, min(max(SPAN_AVERAGE_S * rate_hz, 1e-3), 1000.0), axis=0)
    # 2 cm off the line of its leg a knee's direction counts as much as the moments around.
    return np.asarray(own + 0.02 * around / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-12))
