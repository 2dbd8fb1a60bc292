"""Position and velocity of the vehicle from what its autopilot reports of both, weighed by how they err.

The two reports contradict each other, and which one is the better differs: on one of the recorded autopilots the
velocity errs by 0.25 m/s for seconds, on the other by 0.02 m/s (``lab/studies/report_errors.py``).  The error of the
velocity is therefore a state of a Kalman filter, and its size is estimated in flight, within bounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

#: Time, s, over which the error of a reported velocity fades: recorded ones halve within 2 s.
_FADES_S = 2.5
#: A reported position wanders by itself: as a random walk, m^2/s, at least (recorded of both autopilots), averaged over
#: some seconds.  It counts as noise of what it wanders within the time beside it.
_LEAST_WANDER_M2_S = 4e-4
_WANDER_AVERAGED_S = 5.0
_WANDERED_S = 2.0
#: Bounds of the velocity's estimated standard deviation, m/s: half the best recorded one, twice the worst.
_LEAST_M_S = 0.01
_GREATEST_M_S = 0.6
#: Blocks, s, whose mean errors are compared with the next one's, and the time over which this is averaged.  A position
#: that wanders by itself errs otherwise from block to block; the error of a velocity lasts.
_BLOCK_S = 0.5
_AVERAGED_S = 20.0
#: Longest gap in s that the velocity bridges.
_LONGEST_GAP_S = 0.5
#: A step from one reported position to the next, m, beyond what the velocity explains.  Recorded: 0.1 m at most.
_JUMP_M = 0.5
#: Lasting error of the velocity, m/s, that no healthy autopilot has.  Recorded: 0.9 m/s at most.
_CONTRADICTION_M_S = 1.5


class Doubt(NamedTuple):
    """What a report contradicts: a step of the position in m, a lasting error of the velocity in m/s; 0 = nothing."""

    jump_m: float = 0.0
    error_m_s: float = 0.0

    def worse(self, other: Doubt) -> Doubt:
        """The greater of each."""
        return Doubt(max(self.jump_m, other.jump_m), max(self.error_m_s, other.error_m_s))


class VehicleFilter:
    """Reports of one flight, in the order of their stamps.

    Parameters
    ----------
    velocity_sd_m_s : of the reported velocity, until the flight has shown it

    Attributes
    ----------
    position, velocity : (3,) m, m/s, ENU; NaN before the first report
    velocity_sd : (3,) m/s, estimated error of the reported velocity
    """

    def __init__(self, velocity_sd_m_s: float) -> None:
        self._variance: np.ndarray = np.full(3, velocity_sd_m_s**2)
        self._stamp_s = math.nan
        self._reported: tuple[np.ndarray, np.ndarray] = (np.full(3, np.nan), np.full(3, np.nan))
        self.position: np.ndarray = np.full(3, np.nan)
        self.velocity: np.ndarray = np.full(3, np.nan)
        self._error: np.ndarray = np.zeros(3)  # of the reported velocity
        self._covariance: np.ndarray = np.zeros((3, 2, 2))  # of position and error
        self._wander: np.ndarray = np.full(3, _LEAST_WANDER_M2_S)
        self._block: tuple[float, np.ndarray] = (0.0, np.zeros(3))  # s, and m that the velocity does not explain
        self._before: np.ndarray | None = None  # (3,) m/s, mean of the block before

    @property
    def velocity_offset(self) -> np.ndarray:
        """(3,) m/s, reported minus filtered velocity."""
        return self._error

    @property
    def velocity_sd(self) -> np.ndarray:
        """(3,) m/s."""
        deviation: np.ndarray = np.sqrt(self._variance)
        return deviation

    def take(self, stamp_s: float, position: np.ndarray, velocity: np.ndarray) -> Doubt:
        """Take a report, (3,) m and (3,) m/s ENU, and say what it contradicts.

        After a gap, a step back in time or a jump of the position the filter begins anew at the report.  Stamps may
        jump with the position, as where the autopilot restarts: the way since then is bounded by the longest gap.
        """
        gap_s, jump_m = stamp_s - self._stamp_s, 0.0
        if math.isfinite(gap_s):
            way = min(max(gap_s, 0.0), _LONGEST_GAP_S) * 0.5 * (self._reported[1] + velocity)
            step = position - self._reported[0] - way
            jump_m = float(np.linalg.norm(step))
        if 0.0 < gap_s <= _LONGEST_GAP_S and jump_m <= _JUMP_M:
            self._predict(gap_s, 0.5 * (self._reported[1] + velocity))
            self._correct(gap_s, position)
            self._learn(gap_s, step)
        else:
            self._begin(position)
        self._stamp_s, self._reported = stamp_s, (position, velocity)
        self.velocity = velocity - self._error
        error_m_s = float(np.linalg.norm(self._error))
        return Doubt(
            jump_m if jump_m > _JUMP_M else 0.0,
            error_m_s if error_m_s > _CONTRADICTION_M_S else 0.0,
        )

    def _begin(self, position: np.ndarray) -> None:
        self._block, self._before = (0.0, np.zeros(3)), None
        self.position = position.copy()
        self._covariance = np.zeros((3, 2, 2))
        self._covariance[:, 0, 0], self._covariance[:, 1, 1] = self._wander * _WANDERED_S, self._variance

    def _predict(self, gap_s: float, velocity: np.ndarray) -> None:
        """Move on by a mean reported velocity; its error fades and is renewed."""
        fade = math.exp(-gap_s / _FADES_S)
        self.position = self.position + gap_s * (velocity - self._error)
        self._error = fade * self._error
        step = np.array([[1.0, -gap_s], [0.0, fade]])
        self._covariance = step @ self._covariance @ step.T
        self._covariance[:, 1, 1] += (1.0 - fade**2) * self._variance

    def _correct(self, gap_s: float, position: np.ndarray) -> None:
        """Move towards a reported position."""
        # Reports that follow each other sooner hold less news each.
        noise = self._wander * _WANDERED_S**2 / gap_s
        gain = self._covariance[:, :, 0] / (self._covariance[:, 0, 0] + noise)[:, None]
        innovation = position - self.position
        self.position = self.position + gain[:, 0] * innovation
        self._error = self._error + gain[:, 1] * innovation
        self._covariance = self._covariance - gain[:, :, None] * self._covariance[:, None, 0, :]

    def _learn(self, gap_s: float, step: np.ndarray) -> None:
        """Sizes of the velocity's error and of the position's wander, from a step (3,) m that neither explains."""
        wander = step**2 / gap_s - self._variance * gap_s
        self._wander = np.maximum(
            self._wander + (wander - self._wander) * (1.0 - math.exp(-gap_s / _WANDER_AVERAGED_S)), _LEAST_WANDER_M2_S
        )
        seconds, way = self._block[0] + gap_s, self._block[1] + step
        self._block = (seconds, way)
        if seconds < _BLOCK_S:
            return
        mean, before = way / seconds, self._before
        self._block, self._before = (0.0, np.zeros(3)), mean
        if before is not None:
            found = mean * before * math.exp(seconds / _FADES_S)
            variance = self._variance + (found - self._variance) * (1.0 - math.exp(-seconds / _AVERAGED_S))
            self._variance = np.clip(variance, _LEAST_M_S**2, _GREATEST_M_S**2)
