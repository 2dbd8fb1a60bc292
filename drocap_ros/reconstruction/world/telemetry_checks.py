"""Reasons why the telemetry cannot belong to the images; None = none is found."""

from __future__ import annotations

import numpy as np

from drocap_ros.contacts import ANKLES, LOOKS_AT_REST, PLACED_REST_M_S, rest_likelihood
from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.geometry.rotations import log_so3
from drocap_ros.reconstruction.common.refusal import Refusal, Why
from drocap_ros.reconstruction.world.placement import STILL_M
from drocap_ros.skeleton import BODY_15

#: Time (s) for which the pose of a moving camera stays the same without a new measurement: reports come more often.
_FROZEN_S = 1.0
#: A vehicle stops and starts more slowly than this (m/s^2): gravity, by a tilt of 45 degrees.
_STOP_M_S2 = 10.0
#: Times (s) within which no gimbal turns by so much (degrees) and stands still, or turns evenly, before and after; 0 =
#: one frame.  Simulated orbits at 15 frames per second reach 5.3 degrees in both.
_TURNS_S_DEG = ((0.0, 10.0), (0.12, 12.0))
#: Largest error (s) of a log's time that is tried; a judgement.
_SHIFTS_S = 3.0
#: Error (m) of the places of still feet: twice that of adjusted ones (metric_scale.py).
_STILL_M = 2.0 * STILL_M


def stops(rotation: np.ndarray, position: np.ndarray, fps: float) -> list[slice]:
    """Steps between poses (F, 3, 3), (F, 3) m that stay the same for a second, of a camera that moves otherwise."""
    same = unchanged(rotation, position)
    speed = np.linalg.norm(np.diff(position, axis=0), axis=-1) * fps
    if same.all() or not float(np.median(speed[~same])) > 0.2:  # m/s: a hover drifts more slowly
        return []
    return [slice(begin, end) for begin, end in true_runs(same).tolist() if end - begin >= _FROZEN_S * fps]


def frozen(rotation: np.ndarray, position: np.ndarray, fps: float) -> Refusal | None:
    """Whether the poses (F, 3, 3), (F, 3) m stop, or go on, at once: a vehicle that stops slows down before."""
    from scipy.ndimage import maximum_filter1d

    speed = np.linalg.norm(np.diff(position, axis=0), axis=-1) * fps
    # The first step of a log between two images is a part of one.
    beside = maximum_filter1d(speed, 5, mode="constant")
    at_once = [
        (stop.stop - stop.start) / fps
        for stop in stops(rotation, position, fps)
        if max(beside[stop.start], beside[stop.stop - 1]) > _STOP_M_S2 / fps
    ]
    if not at_once:
        return None
    return Refusal(Why.FROZEN, max(at_once))


def turned_at_once(rotation: np.ndarray, fps: float) -> Refusal | None:
    """Whether rotations (F, 3, 3) jump: a turn that differs from those before and after as no gimbal's does."""
    for within_s, least_deg in _TURNS_S_DEG:
        lag = max(round(within_s * fps), 1)
        turn = log_so3(rotation[lag:] @ np.swapaxes(rotation[:-lag], 1, 2))
        differs = np.linalg.norm(turn[lag:] - turn[:-lag], axis=1)
        jump = np.degrees(np.minimum(differs[:-lag], differs[lag:]).max(initial=0.0))
        # Change of the turn rate of a gimbal (degrees/s^2): what one frame of a low rate may hold.
        if jump > max(least_deg, 500.0 * (lag / fps) ** 2):
            return Refusal(Why.TURNED_AT_ONCE, float(jump))
    return None


def jump_m(position: np.ndarray, fps: float) -> float:
    """Largest jump (m) of positions (F, 3) m, as by a reset of the estimate; 0 = none."""
    # A position jumps, and moves evenly before and after, between two images, one between two states.
    lag = max(round(0.12 * fps), 1)
    move = position[lag:] - position[:-lag]
    differs = np.linalg.norm(move[lag:] - move[:-lag], axis=1)
    jump = float(np.minimum(differs[:-lag], differs[lag:]).max(initial=0.0))
    # Resets of an estimator are larger.
    return jump if jump > max(0.5, _STOP_M_S2 * (lag / fps) ** 2) else 0.0


def upside_down(joints: np.ndarray, rotation: np.ndarray) -> Refusal | None:
    """Whether camera (F, 3, 3) and person (F, P, 3) m both stand on their heads: a log whose z points down."""
    trunk = joints[:, BODY_15.index("neck"), 2] - joints[:, BODY_15.index("pelvis"), 2]
    # Height (m per m) of the image's lower border above its centre, from which a camera is upside down: no orbit's
    # tilt.
    if not (np.median(rotation[:, 1, 2]) > 0.2 and np.median(trunk) < 0.0):
        return None
    return Refusal(Why.UPSIDE_DOWN)


def unchanged(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(F - 1,) whether each pose of (F, 3, 3), (F, 3) m is the one before."""
    # Change (m, or of a rotation's elements) of poses that are the same: the rounding of their interpolation.
    place, turn = (np.abs(np.diff(values, axis=0)) < 1e-9 for values in (position, rotation))
    same: np.ndarray = place.all(-1) & turn.all((-1, -2))
    return same


def stopped(rotation: np.ndarray, position: np.ndarray, stamp_ns: np.ndarray) -> Refusal | None:
    """Whether the newest poses of a camera that has moved before stay the same: no report of a flight does that."""
    changes = np.flatnonzero(~unchanged(rotation, position))
    since = int(changes[-1]) + 1 if len(changes) else 0
    still_s = float(stamp_ns[-1] - stamp_ns[since]) * 1e-9
    return Refusal(Why.STOPPED, still_s) if still_s >= _FROZEN_S else None


def other_time(joints: np.ndarray, rotation: np.ndarray, position: np.ndarray, fps: float) -> Refusal | None:
    """Whether the feet of joints (F, 17, 3) m, placed by the poses, rest more often with poses of another time."""
    seen = (joints[:, ANKLES] - position[:, None]) @ np.swapaxes(rotation, 1, 2)
    shifts = np.arange(-_SHIFTS_S, _SHIFTS_S + 1e-9, 0.5)  # half a step of walking apart
    share = np.array([_still_share(seen, rotation, position, round(shift * fps), fps) for shift in shifts])
    best, own = int(share.argmax()), float(share[len(shifts) // 2])
    # Nearly twice as many still feet, a judgement; fewer than 0.06 tell nothing.
    if share[best] < max(1.8 * own, 0.06):
        return None
    return Refusal(Why.OTHER_TIME, float(shifts[best]))


def resting_feet_move(joints: np.ndarray, still: np.ndarray, fps: float) -> Refusal | None:
    """Whether feet that look at rest move on their path in the world.

    joints : (F, 17, 3) m in the world; still : (F, 2) the network's probability that the right and the left foot rest
    """
    from scipy.ndimage import gaussian_filter1d

    # Between the ends of the way of a foot that looks at rest; a judgement.
    lag = max(round(0.33 * fps), 1)
    if len(joints) <= 2 * lag:
        return None
    # Averaged over two images of 24 Hz.
    feet = gaussian_filter1d(joints[:, ANKLES], 0.08 * fps, axis=0, mode="nearest")
    speed = np.linalg.norm(feet[lag:] - feet[:-lag], axis=-1) * fps / lag
    rests = still[lag // 2 :][: len(speed)]
    weight = np.where(rests > LOOKS_AT_REST, rests, 0.0)
    if weight.mean() < 0.05:  # too few rests to judge
        return None
    resting, moving = _median(speed, weight), _median(speed, np.where(rests > LOOKS_AT_REST, 0.0, 1.0 - rests))
    # On a true path feet at rest are slower than the others.
    if not (resting > PLACED_REST_M_S and resting > 0.7 * moving):
        return None
    return Refusal(Why.RESTING_FEET_MOVE, resting)


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """Weighted median; 0 without any weight."""
    order = np.argsort(values, axis=None)
    total = np.cumsum(weights.reshape(-1)[order])
    return float(values.reshape(-1)[order][np.searchsorted(total, 0.5 * total[-1])]) if total[-1] > 0 else 0.0


def _still_share(seen: np.ndarray, rotation: np.ndarray, position: np.ndarray, later: int, fps: float) -> float:
    """Share of steps over a lag that end where they began, of points (F, 2, 3) m in camera axes; 0 = too few."""
    from scipy.ndimage import gaussian_filter1d

    # Most of the half second for which a walker's foot stands.
    lag = max(round(0.4 * fps), 1)
    frames = len(seen) - abs(later)
    if frames < max(8 * lag, len(seen) // 2):
        return 0.0
    of, at = max(-later, 0), max(later, 0)
    placed = seen[of : of + frames] @ rotation[at : at + frames] + position[at : at + frames, None]
    # Averaged over one or two images of 24 Hz.
    feet = gaussian_filter1d(placed, 0.06 * fps, axis=0, mode="nearest")
    square = np.square(feet[lag:] - feet[:-lag]).sum(-1)
    return float(rest_likelihood(square, _STILL_M).mean())
