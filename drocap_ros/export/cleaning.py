"""Optional cleaning of an export, off by default: a low-pass filter over time, and feet that keep their place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import butter, filtfilt

from drocap_ros.contacts import rest_spans
from drocap_ros.errors import InputError
from drocap_ros.export.take import Take, at_constant_rate, interpolated
from drocap_ros.skeleton import indices

#: A filter of order 2 applied twice has its -3 dB at this share of its cut-off.
_TWICE = (np.sqrt(2.0) - 1.0) ** 0.25
#: Time (s) over which the direction of a knee is averaged: as that of a foot's velocity (contacts.py).
_AVERAGE_S = 0.15
#: Time, s, in which a foot leaves or reaches its place.
_FADE_S = 0.2
#: Farther than this, m, from its median place a foot is not at rest.
_FARTHEST_M = 0.08
#: Change of a leg's half length per turn of its knee at which half of the turn is made; 0.07 is that of 8 degrees.
_DAMPING = 0.07
#: Distance of a knee from the line of its leg at which its direction counts as much as the moments around, m.
_CLEAR_M = 0.02
#: A root that moves less than this is not known in the world, m.
_ROOT_MOVES_M = 0.05


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
    if not len(pelvis) or np.ptp(pelvis, axis=0).max() < _ROOT_MOVES_M:
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
    fade = max(round(_FADE_S * rate_hz), 1)
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
    reach = reach_at(bend + turn * effect**2 / (effect**2 + _DAMPING**2))
    along = (target - hip) / np.maximum(wanted, 1e-9)[:, None]
    foot = (thigh**2 - shank**2 + reach**2) / (2.0 * np.maximum(reach, 1e-9))
    height = np.sqrt(np.maximum(thigh**2 - foot**2, 0.0))
    aside = _aside(knee - hip, ankle - hip, rate_hz)
    aside = aside - along * np.sum(aside * along, axis=1, keepdims=True)
    aside /= np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-9)
    moved = np.any(target != ankle, axis=1)[:, None]
    new_knee = hip + along * foot[:, None] + aside * height[:, None]
    return np.where(moved, new_knee, knee), np.where(moved, hip + along * reach[:, None], ankle)


def _aside(knee: np.ndarray, ankle: np.ndarray, rate_hz: float) -> np.ndarray:
    """(F, 3) direction in which a knee leaves the line from hip to ankle, both (F, 3) from the hip.

    Of a straight leg it is chance: there the bent knees of the moments around count.
    """
    line = ankle / np.maximum(np.linalg.norm(ankle, axis=1, keepdims=True), 1e-9)
    own = knee - line * np.sum(knee * line, axis=1, keepdims=True)
    around = np.nan_to_num(own) * np.linalg.norm(np.nan_to_num(own), axis=1, keepdims=True)
    around = gaussian_filter1d(around, min(max(_AVERAGE_S * rate_hz, 1e-3), 1000.0), axis=0)
    return np.asarray(own + _CLEAR_M * around / np.maximum(np.linalg.norm(around, axis=1, keepdims=True), 1e-12))
