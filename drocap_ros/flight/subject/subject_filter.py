"""Position and velocity of the subject over time: a Kalman filter of the measurements of single images."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from drocap_ros.flight.bridge_config import SubjectConfig
from drocap_ros.flight.observed import NO_HEIGHT, Height
from drocap_ros.flight.subject.guard import Parallax
from drocap_ros.flight.subject.subject_measurement import MAX_BENDING, SubjectMeasurement, locate_subject
from drocap_ros.flight.vehicle import CameraPose
from drocap_ros.keypoints import PoseObservation
from drocap_ros.stamps import NS

STANDING_M_S = 0.3  # speed that the estimate of one who stands has
WALKING_M_S = 0.5  # least speed of one who walks
#: Memory of the ground by the body, and least images: several strides and a second; where the reported height wanders,
#: a second, within which recorded ones change by 0.1 m, and half of one.
_MEMORY, _WANDERING = (4 * NS, 15), (1 * NS, 8)
_QUANTILE = (
    0.6  # of the ground's height, a little more than the median: bending makes the body look smaller, so farther
)
#: (6, 6): a place and a velocity that stay, and by the second what the velocity adds to the place.
_STAYS, _MOVES = np.eye(6), np.eye(6, k=3)


@dataclass(frozen=True)
class SubjectEstimate:
    """The subject at one instant.

    position, velocity : (3,) m, m/s ENU
    covariance : (6, 6) of the filter; ``position_sd_m`` holds the systematic error too
    stamp_ns : exposure of the last image that was accepted
    age_s : since then
    contradicted : whether an image since then showed another track, or a subject where this one cannot be
    nearer : share of his distance from the camera by which the nearer of body size and ground puts him nearer
    ground : his ground by his body alone, over the last seconds
    heading_error : rad, of the vehicle's heading, reported less true
    """

    position: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray
    position_sd_m: float
    stamp_ns: int
    age_s: float
    track_id: int
    contradicted: bool = False
    nearer: float = 0.0
    ground: Height = NO_HEIGHT
    heading_error: float = 0.0


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
    # Beyond a third of the range the gate decides.
    if not 0.0 < surprise < 0.3 * distance:
        return np.zeros((3, 3))
    return surprise**2 * np.outer(along, along)


class SubjectFilter:
    """Kalman filter of position and velocity, white acceleration; measurements must come in the order of stamps.

    It reads no clock.  A measurement outside the gate does not refresh the estimate.
    """

    def __init__(self, config: SubjectConfig) -> None:
        self._config = config
        #: Whether the vehicle's height wanders within seconds.
        self.height_wanders = False
        self._state: np.ndarray | None = None
        self._covariance = np.eye(6)
        self._systematic = np.eye(3)
        self._stamp_ns = 0
        self._track_id = 0
        self._contradicted = False
        self._ground, self._grounds = NO_HEIGHT, deque[tuple[int, float]]()
        self._nearer = 0.0
        #: rad, of the reported heading.
        self.heading_sd = math.radians(config.attitude_error_deg)
        self._parallax = Parallax(config.size_error, self.heading_sd)
        self._turned = 0, 0.0  # stamp of the last picture, and what the heading had turned there

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
        if camera is None:
            return False
        measured = locate_subject(observation, camera_matrix, camera, self._config, self._ground)
        if measured is None:
            return False
        gap_s = (observation.stamp_ns - self._stamp_ns) / NS
        self._turn(observation.stamp_ns, camera.turned)
        sight = measured.position - camera.position
        measurement = measured._replace(position=camera.position + self._parallax.corrected(sight))
        other = observation.track_id != self._track_id
        strange = self._state is None or other
        if strange if locked else strange or abs(gap_s) > 2.0:
            return self._restart(observation, measurement, locked=locked)
        if gap_s <= 0:
            return False
        state, covariance = self._predicted(min(gap_s, 5.0))
        innovation = measurement.position - state[:3]
        noise = measurement.noise + _range_noise(measurement, innovation, covariance[:3, :3], camera.position)
        spread = covariance[:3, :3] + noise
        inverse = np.linalg.inv(spread)
        if float(innovation @ inverse @ innovation) > self._config.subject_gate:
            return self._restart(observation, measurement, locked=locked or gap_s <= 1.0)
        gain = covariance[:, :3] @ inverse
        self._state = state + gain @ innovation
        covariance = covariance - gain @ covariance[:3]
        self._covariance = 0.5 * (covariance + covariance.T)
        self._systematic = measurement.systematic
        self._stamp_ns, self._contradicted = observation.stamp_ns, False
        self._nearer += (measurement.nearer - self._nearer) * min(gap_s, 1.0)  # over a second
        self._learn_ground(measurement, observation.stamp_ns)
        self._parallax.take(camera.position[:2], sight[:2], gap_s, float(np.hypot(*self._state[3:5])))
        return True

    def _restart(self, observation: PoseObservation, measurement: SubjectMeasurement, *, locked: bool) -> bool:
        """Begin anew with a measurement that is not the subject's; where it is locked, it contradicts him."""
        if locked:
            self._contradicted = True
        else:
            self._start(observation, measurement)
        return not locked

    def _turn(self, stamp_ns: int, turned: float) -> None:
        """The heading's error moves on from picture to picture."""
        before_ns, before = self._turned
        self._turned = stamp_ns, turned
        if 0 < stamp_ns - before_ns < 5 * NS:
            self._parallax.turn((stamp_ns - before_ns) / NS, turned - before)

    def estimate(self, now_ns: int) -> SubjectEstimate | None:
        """The subject predicted to ``now_ns`` (half a second at most); None before the first measurement."""
        if self._state is None:
            return None
        age_s = (now_ns - self._stamp_ns) / NS
        state, covariance = self._predicted(min(max(age_s, 0.0), 0.5))
        total = covariance[:3, :3] + self._systematic
        return SubjectEstimate(
            position=state[:3],
            velocity=state[3:],
            covariance=covariance,
            position_sd_m=float(np.sqrt(np.linalg.eigvalsh(total[:2, :2])[-1])),
            stamp_ns=self._stamp_ns,
            age_s=age_s,
            track_id=self._track_id,
            contradicted=self._contradicted,
            nearer=self._nearer,
            ground=self._ground,
            heading_error=self._parallax.heading,
        )

    def _learn_ground(self, measurement: SubjectMeasurement, stamp_ns: int) -> None:
        """His ground by his body over the last seconds.

        Bending makes the body look smaller, never larger, so unequal bones do not count, and a little more than the
        median does.  A quantile does not follow a few wrong images, the first ones least of all.
        """
        if math.isfinite(measurement.ground.m) and measurement.bending < MAX_BENDING:  # NaN is not
            self._grounds.append((stamp_ns, measurement.ground.m))
        memory_ns, least = _WANDERING if self.height_wanders else _MEMORY
        while self._grounds and stamp_ns - self._grounds[0][0] > memory_ns:
            self._grounds.popleft()
        if len(self._grounds) >= least:
            height_m = float(np.quantile([height for _, height in self._grounds], _QUANTILE))
            sd_m = measurement.ground.sd_m
            self._ground = Height(height_m, sd_m if math.isfinite(sd_m) else self._ground.sd_m)

    def _start(self, observation: PoseObservation, measurement: SubjectMeasurement) -> None:
        self._state = np.concatenate([measurement.position, np.zeros(3)])
        self._covariance = np.diag([0.0] * 3 + [1.0, 1.0, 0.1])
        self._covariance[:3, :3] = measurement.noise
        self._systematic, self._nearer = measurement.systematic, measurement.nearer
        if observation.track_id != self._track_id:  # another person
            self._grounds.clear()
            self._ground = NO_HEIGHT
            self._parallax = Parallax(self._config.size_error, self.heading_sd)
        self._parallax.lose()
        self._stamp_ns, self._track_id = observation.stamp_ns, observation.track_id
        self._contradicted = False
        self._learn_ground(measurement, observation.stamp_ns)

    def _predicted(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        assert self._state is not None
        move = _STAYS + dt * _MOVES
        push = 0.5 * dt * dt * _STAYS[:, :3] + dt * _STAYS[:, 3:]
        # White acceleration of this standard deviation over a second, whatever the step.
        variance = self._config.subject_acceleration_m_s2**2 * np.array([1.0, 1.0, 0.1]) / max(dt, 1e-3)
        noise = push @ (variance[:, None] * push.T)
        # The vehicle's position and the feet that are set down drift by 5 cm in a second: no motion of the subject.
        noise[:3, :3] += 0.05**2 * dt * _STAYS[:3, :3]
        return move @ self._state, move @ self._covariance @ move.T + noise
