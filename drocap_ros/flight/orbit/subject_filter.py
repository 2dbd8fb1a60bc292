"""Position and velocity of the subject over time: a Kalman filter of the measurements of single images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drocap_ros.flight.orbit.pose_history import CameraPose
from drocap_ros.flight.orbit.subject_measurement import SubjectMeasurement, locate_subject
from drocap_ros.flight.subject_config import SubjectConfig
from drocap_ros.observation import PoseObservation

_NS = 1_000_000_000
_DRIFT = 0.05  # m/sqrt(s), of the vehicle's position and of the feet that are set down; no motion of the subject
_RATIO_NOISE, _RATIO_WANDER = 0.035, 0.02  # of the logarithm of size over ground: of one image; 1/sqrt(s)
_BENDING_BY_NOISE = 0.1
_MAX_SURPRISE = 0.3  # share of the range, beyond which the gate decides


@dataclass(frozen=True)
class SubjectEstimate:
    """The subject at one instant.

    position, velocity : (3,) m, m/s ENU
    covariance : (6, 6) of the filter; ``position_sd_m`` holds the systematic error too
    stamp_ns : exposure of the last image that was accepted
    age_s : since then
    """

    position: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray
    position_sd_m: float
    stamp_ns: int
    age_s: float
    track_id: int


def _range_noise(
    measurement: SubjectMeasurement, innovation: np.ndarray, covariance: np.ndarray, camera: np.ndarray
) -> np.ndarray:
    """(3, 3) m^2 to add along the line of sight for an unexpected range: a lifted foot, a wrong ankle.

    The bearing keeps its noise.
    """
    ray = measurement.position - camera
    distance = float(np.hypot(ray[0], ray[1]))
    along = ray / max(distance, 1e-6)
    ahead = np.array([along[0], along[1], 0.0])
    usual = 2.0 * float(np.sqrt(ahead @ (covariance + measurement.noise) @ ahead))
    surprise = abs(float(innovation @ ahead)) - usual
    if not 0.0 < surprise < _MAX_SURPRISE * distance:
        return np.zeros((3, 3))
    return surprise**2 * np.outer(along, along)


class SubjectFilter:
    """Kalman filter of position and velocity, white acceleration; measurements must come in the order of stamps.

    It reads no clock.  A frozen image (the same keypoints bit for bit) and a measurement outside the gate do not
    refresh the estimate.
    """

    def __init__(self, config: SubjectConfig) -> None:
        self._config = config
        self._state: np.ndarray | None = None
        self._covariance = np.eye(6)
        self._systematic = np.eye(3)
        self._stamp_ns = 0
        self._track_id = 0
        self._last_keypoints: np.ndarray | None = None
        self._ratio = float("nan")
        self._ratio_variance = 0.0

    def update(
        self,
        observation: PoseObservation,
        camera_matrix: np.ndarray,
        camera: CameraPose | None,
        *,
        locked: bool = False,
    ) -> bool:
        """Take one image's keypoints; returns whether they were accepted.

        locked : the vehicle flies by this estimate, so neither another track nor a far measurement may restart it
        """
        frozen = self._last_keypoints is not None and np.array_equal(
            self._last_keypoints, observation.keypoints, equal_nan=True
        )
        self._last_keypoints = observation.keypoints
        if camera is None or frozen or not observation.has_subject:
            return False
        measurement = locate_subject(observation, camera_matrix, camera, self._config, self._ratio)
        if measurement is None:
            return False
        gap_s = (observation.stamp_ns - self._stamp_ns) / _NS
        other = observation.track_id != self._track_id
        if locked and (self._state is None or other):
            return False
        if self._state is None or (not locked and (other or abs(gap_s) > 2.0)):
            self._start(observation, measurement)
            return True
        if gap_s <= 0:
            return False
        state, covariance = self._predicted(min(gap_s, 5.0))
        innovation = measurement.position - state[:3]
        noise = measurement.noise + _range_noise(measurement, innovation, covariance[:3, :3], camera.position)
        spread = covariance[:3, :3] + noise
        inverse = np.linalg.inv(spread)
        if float(innovation @ inverse @ innovation) > self._config.subject_gate:
            if not locked and gap_s > 1.0:
                self._start(observation, measurement)
                return True
            return False
        gain = covariance[:, :3] @ inverse
        self._state = state + gain @ innovation
        covariance = covariance - gain @ covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._systematic = measurement.systematic
        self._stamp_ns = observation.stamp_ns
        self._learn_ratio(measurement, gap_s)
        return True

    def estimate(self, now_ns: int) -> SubjectEstimate | None:
        """The subject predicted to ``now_ns`` (half a second at most); None before the first measurement."""
        if self._state is None:
            return None
        age_s = (now_ns - self._stamp_ns) / _NS
        state, covariance = self._predicted(min(max(age_s, 0.0), 0.5))
        total = covariance[:3, :3] + self._systematic
        return SubjectEstimate(
            position=state[:3], velocity=state[3:], covariance=covariance,
            position_sd_m=float(np.sqrt(np.linalg.eigvalsh(total[:2, :2])[-1])),
            stamp_ns=self._stamp_ns, age_s=age_s, track_id=self._track_id,
        )  # fmt: skip

    def _learn_ratio(self, measurement: SubjectMeasurement, gap_s: float) -> None:
        """Track the ratio of the two ranges: a Kalman filter of its logarithm, a random walk.

        Bending makes the body look smaller, never larger, so larger ratios and unequal bones get less weight.
        """
        ratio = measurement.range_size_m / measurement.range_ground_m
        if not 0.5 < ratio < 2.0:  # NaN too
            return
        bent = max(measurement.bending - _BENDING_BY_NOISE, 0.0)
        if np.isnan(self._ratio):
            self._ratio, self._ratio_variance = ratio, _RATIO_NOISE**2 + bent**2
            return
        innovation = float(np.log(ratio / self._ratio))
        variance = _RATIO_NOISE**2 + bent**2 + max(innovation, 0.0) ** 2
        self._ratio_variance += _RATIO_WANDER**2 * gap_s
        gain = self._ratio_variance / (self._ratio_variance + variance)
        self._ratio *= float(np.exp(gain * innovation))
        self._ratio_variance *= 1 - gain

    def _start(self, observation: PoseObservation, measurement: SubjectMeasurement) -> None:
        self._state = np.concatenate([measurement.position, np.zeros(3)])
        self._covariance = np.diag([0.0] * 3 + [1.0, 1.0, 0.1])
        self._covariance[:3, :3] = measurement.noise
        self._systematic = measurement.systematic
        self._stamp_ns, self._track_id = observation.stamp_ns, observation.track_id

    def _predicted(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        assert self._state is not None
        move = np.eye(6)
        move[:3, 3:] = dt * np.eye(3)
        push = np.concatenate([0.5 * dt * dt * np.eye(3), dt * np.eye(3)])
        # White acceleration of this standard deviation over a second, whatever the step.
        variance = self._config.subject_acceleration_m_s2**2 * np.array([1.0, 1.0, 0.1]) / max(dt, 1e-3)
        noise = push @ (variance[:, None] * push.T)
        noise[:3, :3] += _DRIFT**2 * dt * np.eye(3)
        return move @ self._state, move @ self._covariance @ move.T + noise
