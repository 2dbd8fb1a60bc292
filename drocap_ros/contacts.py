"""When a foot rests on the ground: one notion for the adjustment, the metric scale, the report, exports and evaluation.

Three signs tell that a foot rests: it is slow, it is at the height of the floor, and it looks at rest to the lifter.
:class:`RestingFeet` weighs all three.  What judges one sign selects the feet by another one:

- the metric scale and the time of a log make feet slow: :func:`rest_likelihood` of their ways;
- the report measures the speed of feet that rest by their height: :func:`speed_of_lowest`;
- the check of a log measures the speed of feet that look at rest: ``LOOKS_AT_REST``;
- evaluation measures the speed of feet whose true speed is below ``TRUE_REST_M_S``: :func:`step_speed`;
- an export holds feet in place while they are slow, as a motion file has no looks: :func:`rest_spans`.
"""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.interpolation import true_runs
from drocap_ros.skeleton import BODY_17, indices

#: Points of the feet that rest on the ground, ankles first, in ``BODY_17``.
FEET = np.array(indices(BODY_17.joints, ("rankle", "lankle", "rtoe", "ltoe")))
ANKLES = FEET[:2]
#: Height (m) of a resting ankle above the floor.
ANKLE_M = 0.07
#: Heights (m) of resting points above that of a resting ankle: toes lie lower.
FEET_HEIGHT_M = np.array([0.0, 0.0, -0.06, -0.06])

#: Speed (m/s) of a foot at rest whose path is the truth: the definition of the error measure "feet".
TRUE_REST_M_S = 0.1
#: The same of a foot of a finished motion: of 523 takes with walks, runs, jumps and squats that are no fast runs, the
#: lower foot exceeds it in none (report/checks.py).
MOTION_REST_M_S = 0.4
#: The same of a foot that telemetry has placed and nothing has adjusted: it jitters, on true paths at 0.5 m/s at most.
PLACED_REST_M_S = 0.55
#: Probability of the lifter from which a foot looks at rest.
LOOKS_AT_REST = 0.5
#: Standard deviation (m) of the height of a foot at rest while the floor is not known: steps and slopes.
HEIGHT_STD_M = 0.1

#: Likelihood of a foot that moves, against that of one that rests at the floor: while scale and camera are found, which
#: false contacts bend, and when feet are locked in their places (docs/accuracy.md: 0.12 to 1 tried).
MOVING, MOVING_LOCKED = 0.5, 0.12

#: Time (s) over which the velocity of a foot of a finished motion is averaged, and least duration of its rest.
SPAN_AVERAGE_S = 0.15
SHORTEST_SPAN_S = 0.2  # the latter


class RestingFeet:
    """Probability that ankles and toes of one window rest; joints and floor change while they are adjusted.

    seen : (F, P) bool, of the joints; a toe or an ankle that no network sees is the lifter's guess and holds no foot
    fps : frames per second
    looks : (F, 2) the lifter's probability that the right and the left foot rest, 0 or 1 where somebody says so; None =
        unknown
    start : (F, P, 3) m, joints before the adjustment, which show feet that part; None = unknown
    """

    def __init__(
        self, seen: np.ndarray, fps: float, looks: np.ndarray | None = None, start: np.ndarray | None = None
    ) -> None:
        self._fps = fps
        known = seen[:, FEET].copy()
        known[:, : len(ANKLES)] = ankles_seen(seen, fps)
        self._known = known[1:] & known[:-1]
        self._odds, self._together = np.ones((len(seen) - 1, 4)), np.ones((len(seen) - 1, 2))
        self._said: np.ndarray = np.full((len(seen) - 1, 2), np.nan)
        if looks is not None:
            steps = 0.5 * (looks[1:] + looks[:-1])
            self._said = np.where((steps == 0.0) | (steps == 1.0), steps, np.nan)
            # Bounds: neither a foot in contact nor a moving one depends on the lifter's probability alone.
            sure = np.clip(steps, 0.01, 0.99)
            self._odds = np.tile(sure / (1.0 - sure), 2)
            if start is not None:
                self._together = _resting_together(sure, parting_speed(start, fps))

    def probability(self, joints: np.ndarray, floor: float, speed_std_m_s: float, moving: float = MOVING) -> np.ndarray:
        """(F - 1, 4) for each step between two frames of each of ``FEET``.

        joints : (F, P, 3) m, z up
        floor : m, height of a resting ankle
        speed_std_m_s : of a foot in contact, as far as the present joints are accurate
        moving : likelihood of a foot that moves, against that of one that rests
        """
        feet = joints[:, FEET]
        speed = _averaged(step_speed(feet, self._fps))
        height = step_height(feet, floor)
        resting = np.exp(-0.5 * np.square(speed / speed_std_m_s) - 0.5 * np.square(height / HEIGHT_STD_M))
        resting *= self._odds
        # Right and left of a pair: both rest, one does, or none.
        right, left = resting[:, ::2], resting[:, 1::2]
        both = right * left * self._together
        total = both + moving * (right + left + moving)
        probability = np.empty_like(resting)
        probability[:, ::2], probability[:, 1::2] = (both + moving * right) / total, (both + moving * left) / total
        said = np.tile(self._said, 2)
        return np.where(np.isfinite(said), said, probability * self._known)


def step_speed(points: np.ndarray, rate_hz: float | np.ndarray) -> np.ndarray:
    """(F - 1, N) m/s of points (F, N, 3) m between frames; the rate is one number or (F - 1,) of the steps."""
    return np.asarray(np.linalg.norm(np.diff(points, axis=0), axis=-1) * np.reshape(rate_hz, (-1, 1)))


def step_height(feet: np.ndarray, floor: float) -> np.ndarray:
    """(F - 1, 4) m of ``FEET`` (F, 4, 3) between frames, above the place of a resting one."""
    return np.asarray(0.5 * (feet[1:, :, 2] + feet[:-1, :, 2]) - floor - FEET_HEIGHT_M)


def rest_likelihood(square: np.ndarray, std: float) -> np.ndarray:
    """Likelihood of ways, or speeds, whose squares these are, of feet that rest with an error of ``std``."""
    return np.asarray(np.exp(-0.5 * square / std**2))


def ankles_seen(seen: np.ndarray, fps: float) -> np.ndarray:
    """(F, 2) whether a network saw the ankle, of joints (F, P), at the frame or shortly before or after it."""
    from scipy.ndimage import maximum_filter1d

    # Time (s) for which a foot that is not seen keeps its contact: a quarter of a cycle of walking.
    return np.asarray(maximum_filter1d(seen[:, ANKLES], 2 * round(0.25 * fps) + 1, axis=0, mode="nearest"))


def parting_speed(joints: np.ndarray, fps: float) -> np.ndarray:
    """(F - 1, 2) m/s of joints (F, 17, 3): change of the vector between the ankles, and between the toes.

    Errors of the camera's place do not enter: it shows a small step that the network takes for rest, before the
    adjustment has bent the body so that both feet rest.
    """
    feet = joints[:, FEET]
    change = _averaged(np.diff(feet[:, ::2] - feet[:, 1::2], axis=0) * fps)
    return np.asarray(np.linalg.norm(change, axis=-1))


def speed_of_lowest(feet: np.ndarray, step_s: np.ndarray) -> float:
    """Median speed (m/s) of the lower foot of (F, 2, 3) m in the half of the steps (F - 1,) s in which it is lowest.

    It is near 0 for a person who stands or walks.
    """
    speed = np.linalg.norm(np.diff(feet, axis=0) / step_s[:, None, None], axis=2)
    height = 0.5 * (feet[1:, :, 2] + feet[:-1, :, 2])
    lower = height.argmin(axis=1)[:, None]
    speed, height = (np.take_along_axis(values, lower, axis=1)[:, 0] for values in (speed, height))
    return float(np.median(speed[height <= np.median(height)]))


def rest_spans(foot: np.ndarray, rate_hz: float) -> list[tuple[int, int]]:
    """First and end frame of each time in which a foot (F, 3) m, NaN where unknown, of a finished motion rests."""
    from scipy.ndimage import uniform_filter1d

    velocity = np.gradient(foot, axis=0) * rate_hz
    width = min(max(round(SPAN_AVERAGE_S * rate_hz), 1), len(foot))
    known = np.isfinite(velocity).all(axis=1)
    # The running average would carry NaN on to the end.
    average = uniform_filter1d(np.where(known[:, None], velocity, 0.0), width, axis=0, mode="nearest")
    whole = uniform_filter1d(known.astype(np.float64), width, mode="nearest") > 1.0 - 1e-6
    still = whole & (np.linalg.norm(average, axis=1) < MOTION_REST_M_S)
    return [(int(a), int(b)) for a, b in true_runs(still) if b - a >= max(SHORTEST_SPAN_S * rate_hz, 2)]


def _resting_together(looks: np.ndarray, parting: np.ndarray) -> np.ndarray:
    """(F - 1, 2) likelihood that resting ankles, and toes, part so fast; 1 where not both feet look at rest."""
    # Probability of the lifter from which both feet look at rest together.
    at_rest = looks.min(axis=1) > 0.8
    if not at_rest.any():
        return np.ones(parting.shape)
    # At least the median of demo sessions, where a foot that moves parts at 0.3 m/s; where keypoints are noisier, most
    # pairs that look at rest do rest.
    std = np.maximum(0.07, 0.7 * np.median(parting[at_rest], axis=0))
    return np.where(at_rest[:, None], np.exp(-0.5 * np.square(parting / std)), 1.0)


def _averaged(values: np.ndarray) -> np.ndarray:
    from scipy.ndimage import uniform_filter1d

    # In single steps false contacts set the scale off by 6 %.
    return np.asarray(uniform_filter1d(values, min(3, max(len(values), 1)), axis=0, mode="nearest"))
