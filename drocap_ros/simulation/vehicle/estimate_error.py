"""Slow error of an autopilot's position estimate."""

from __future__ import annotations

import math

import numpy as np

_DRIFT_S = 20.0
#: Beside the wandering.  Flown from their setpoints alone, PX4's recorded orbits move off the simulated ones by 0.26 m
#: (RMS) within 4 s, and never by more than 0.53 m: this vehicle, with its estimate's error, by 0.3 m.
_WANDERER_DRIFT_S = 100.0
_WANDER_S, _WANDER_M = 4.0, np.array([0.3, 0.3, 0.3])
_DEAD_RECKONING_M_S = np.array([0.15, 0.075, 0.0])


class EstimateError:
    """Error of the estimated position, ENU, stepped in time.

    ``glitch`` may be changed: (3,) m that the autopilot accepted, and keeps.

    Parameters
    ----------
    noise_m : standard deviation; 0 = none
    wanders : PX4's estimate turns about smoothly by some decimetres, also in height, and the vehicle follows it
    """

    def __init__(self, noise_m: float, wanders: bool, seed: int) -> None:
        self._rng = np.random.default_rng([seed, 0xC0])
        self._noise = noise_m * np.array([1, 1, 0.5])
        self._offset: np.ndarray = self._noise * self._rng.standard_normal(3)
        self.glitch: np.ndarray = np.zeros(3)
        self.velocity: np.ndarray = np.zeros(3)
        # Two lags in a row: the standard deviation of the input is that of the output times the root of two.
        self._wander = math.sqrt(2.0) * _WANDER_M * (noise_m > 0) * wanders
        self._input: np.ndarray = self._wander * self._rng.standard_normal(3)
        self._smooth: np.ndarray = self._input / 2

    @property
    def position(self) -> np.ndarray:
        """(3,) m, estimate less truth."""
        return self._offset + self._smooth + self.glitch

    def step(self, dead_reckoning: bool, dt: float) -> None:
        """Advance by ``dt`` seconds; without satellites it drifts away."""
        if self._noise.any():
            decay = math.exp(-dt / (_WANDERER_DRIFT_S if self._wander.any() else _DRIFT_S))
            self._offset = decay * self._offset + self._noise * math.sqrt(1 - decay**2) * self._rng.standard_normal(3)
        if self._wander.any():
            decay = math.exp(-dt / _WANDER_S)
            noise = self._wander * math.sqrt(1 - decay**2)
            self._input = decay * self._input + noise * self._rng.standard_normal(3)
            self.velocity = (1 - decay) * (self._input - self._smooth) / dt
            self._smooth = self._smooth + self.velocity * dt
        if dead_reckoning:
            self.glitch = self.glitch + _DEAD_RECKONING_M_S * dt
