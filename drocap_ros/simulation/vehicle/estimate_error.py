"""Errors of an autopilot's estimate of its position and velocity, as the real ones report them."""

from __future__ import annotations

import numpy as np

from drocap_ros.flight.autopilot.simulated import ReportErrors

_STEP_S = 0.1  # of the fitted processes; between their steps the errors are interpolated
_DEAD_RECKONING_M_S = np.array([0.15, 0.075, 0.0])  # drift without satellites


class EstimateError:
    """Error of the estimated position and velocity, ENU, stepped in time; ``share`` of the recorded size, 0 = none.

    ``glitch`` may be changed: (3,) m that the autopilot accepted, and keeps.
    """

    def __init__(self, horizontal: ReportErrors, vertical: ReportErrors, share: float, seed: int) -> None:
        from scipy.linalg import solve_discrete_lyapunov

        self._rng = np.random.default_rng([seed, 0xC0])
        self.glitch: np.ndarray = np.zeros(3)
        axes = (horizontal, horizontal, vertical)
        self._transition = np.stack([np.vstack([np.hstack([a.first, a.second]), np.eye(2, 4)]) for a in axes])
        covariance = np.stack([_covariance(axis) for axis in axes]) * share**2
        self._noise = np.linalg.cholesky(covariance + 1e-18 * np.eye(2))
        driven = np.pad(covariance, ((0, 0), (0, 2), (0, 2)))
        steady = [solve_discrete_lyapunov(*pair) for pair in zip(self._transition, driven, strict=True)]
        self._state: np.ndarray = np.stack(
            [self._rng.multivariate_normal(np.zeros(4), spread, method="eigh") for spread in steady]
        )
        self._part = 0.0

    @property
    def position(self) -> np.ndarray:
        """(3,) m, estimate less truth."""
        error: np.ndarray = self._between()[:, 0] + self.glitch
        return error

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s, estimate less truth."""
        return self._between()[:, 1]

    def step(self, dead_reckoning: bool, dt: float) -> None:
        """Advance by ``dt`` seconds; without satellites it drifts away."""
        self._part += dt / _STEP_S
        while self._part >= 1.0:
            self._part -= 1.0
            state = np.einsum("aij,aj->ai", self._transition, self._state)
            state[:, :2] += np.einsum("aij,aj->ai", self._noise, self._rng.standard_normal((3, 2)))
            self._state = state
        if dead_reckoning:
            self.glitch = self.glitch + _DEAD_RECKONING_M_S * dt

    def _between(self) -> np.ndarray:
        """(3, 2) position and velocity per axis, interpolated from the step before to the last one."""
        between: np.ndarray = (1.0 - self._part) * self._state[:, 2:] + self._part * self._state[:, :2]
        return between


def _covariance(axis: ReportErrors) -> np.ndarray:
    """(2, 2) of the noise of one step."""
    both = axis.correlation * axis.noise[0] * axis.noise[1]
    return np.array([[axis.noise[0] ** 2, both], [both, axis.noise[1] ** 2]])
