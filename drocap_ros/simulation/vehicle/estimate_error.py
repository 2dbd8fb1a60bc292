"""Errors of an autopilot's estimate of its position and velocity, as the real ones report them."""

from __future__ import annotations

import numpy as np

from drocap_ros.flight.autopilot.simulated import ReportErrors

_STEP_S = 0.1  # of the fitted processes; between their steps the errors are interpolated
_SETTLED = 600  # steps from zero: several times the longest correlation, 13 s
_DEAD_RECKONING_M_S = np.array([0.15, 0.075, 0.0])  # drift without satellites


class EstimateError:
    """Error of the estimated position and velocity, ENU, stepped in time; ``share`` of the recorded size, 0 = none.

    ``glitch`` may be changed: (3,) m that the autopilot accepted, and keeps.
    """

    def __init__(self, horizontal: ReportErrors, vertical: ReportErrors, share: float, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 0xC0])
        self.glitch: np.ndarray = np.zeros(3)
        axes = (horizontal, horizontal, vertical)
        self._first, self._second = (np.array(rows) for rows in zip(*((a.first, a.second) for a in axes), strict=True))
        self._noise = share * np.array([axis.noise for axis in axes])
        self._correlation = np.array([axis.correlation for axis in axes])
        self._now, self._before = np.zeros((3, 2)), np.zeros((3, 2))
        self._part = 0.0
        for _ in range(_SETTLED):
            self._advance()
        self._between: np.ndarray = self._before  # (3, 2) of position and velocity per axis, now

    @property
    def position(self) -> np.ndarray:
        """(3,) m, estimate less truth."""
        error: np.ndarray = self._between[:, 0] + self.glitch
        return error

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s, estimate less truth."""
        return self._between[:, 1]

    def step(self, dead_reckoning: bool, dt: float) -> None:
        """Advance by ``dt`` seconds; without satellites it drifts away."""
        self._part += dt / _STEP_S
        while self._part >= 1.0:
            self._part -= 1.0
            self._advance()
        self._between = (1.0 - self._part) * self._before + self._part * self._now
        if dead_reckoning:
            self.glitch = self.glitch + _DEAD_RECKONING_M_S * dt

    def _advance(self) -> None:
        """One step of the processes, by sums in a fixed order: the same bits wherever the arrays lie in memory."""
        (one, other), now, before = self._rng.standard_normal((2, 3)), self._now, self._before
        noise = np.stack([one, self._correlation * one + np.sqrt(1.0 - self._correlation**2) * other], axis=1)
        after = self._first[:, :, 0] * now[:, :1] + self._first[:, :, 1] * now[:, 1:]
        after = after + self._second[:, :, 0] * before[:, :1] + self._second[:, :, 1] * before[:, 1:]
        self._now, self._before = after + self._noise * noise, now
