"""The subject by image size and bearing alone, independent of the filter, of the planner and of the ground.

Neither the ground, nor the ratio of two ranges, nor the reference of the orbit enters.  An image that shows the subject
where he cannot be, since the last image that was sure, refreshes nothing: the age of that one counts.  A subject who
recedes may be followed as fast as his image surely shrinks, for as long as it does.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.bridge_config import SubjectConfig
from drocap_ros.flight.observed import SizeSight
from drocap_ros.flight.subject.subject_measurement import (
    BENT,
    MAX_BENDING,
    SIZE_NOISE,
    SubjectMeasurement,
    locate_subject,
)
from drocap_ros.flight.vehicle import CameraPose
from drocap_ros.keypoints import PoseObservation
from drocap_ros.stamps import NS

#: Of the error that pictures have in common beside range and heading: least and first standard deviation, m, and how
#: long it lasts: the vehicle's position errs by 0.26 m at worst, and recorded errors halve within 2 s.
_LEAST_M, _FIRST_M, _LASTS_S = 0.05, 0.3, 5.0
_SCALE_S, _HEADING_S = 60.0, 20.0  # within which both errors wander
#: rad/s, rad per root of a second: of the gyroscope's rate, its scale included, and of its sum.
_GYRO, _GYRO_WALK = math.radians(0.5), math.radians(0.5)
_MOST_RAD = math.radians(40.0)


class Parallax:
    """The place of one subject who stands, and what is wrong alike in all pictures of him: a Kalman filter.

    The vehicle's own way about him shows both.  How the error of the heading changes is known: by as much as the
    reported heading turns beyond the rates of the gyroscope, less an error of these.

    scale : multiplies a measured range
    heading : rad, reported less true
    size_error, heading_sd : standard deviations of both: what is believed before the vehicle moves
    """

    def __init__(self, size_error: float, heading_sd: float) -> None:
        self._usual = np.array([size_error, heading_sd])
        self._state = np.array([0.0, 0.0, 1.0, 0.0, 0.0])  # place, scale, heading, error of the gyroscope
        self._covariance = np.diag([0.0, 0.0, size_error**2, heading_sd**2, _GYRO**2])
        self._noise = _FIRST_M**2

    @property
    def scale(self) -> float:
        """Factor of a measured range."""
        return float(self._state[2])

    @property
    def heading(self) -> float:
        """rad, reported less true."""
        return float(self._state[3])

    def lose(self) -> None:
        """Forget the place."""
        self._covariance[:2], self._covariance[:, :2] = 0.0, 0.0

    def corrected(self, sight: np.ndarray) -> np.ndarray:
        """(2,) or (3,) m, from the camera to the subject as measured, without both errors."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        turned = np.array([c * sight[0] + s * sight[1], c * sight[1] - s * sight[0], *sight[2:]])
        return self.scale * turned

    def turn(self, seconds: float, turned: float) -> None:
        """Move on in time; ``turned`` : rad, of the reported heading beyond the gyroscope's."""
        fade, (size_error, _) = math.exp(-seconds / _SCALE_S), self._usual
        move = np.diag([1.0, 1.0, fade, 1.0, 1.0])
        move[3, 4] = seconds
        self._state = move @ self._state + [0.0, 0.0, 1.0 - fade, turned, 0.0]
        self._covariance = move @ self._covariance @ move.T
        self._covariance[2, 2] += (1.0 - fade**2) * size_error**2
        self._covariance[3, 3] += seconds * _GYRO_WALK**2

    def take(self, place: np.ndarray, sight: np.ndarray, seconds: float, speed_m_s: float) -> None:
        """Take a picture; the faster the subject, the less is left of his place.

        place : (2,) m, of the camera in the map frame
        sight : (2,) m, from there to the subject as measured
        seconds : since the picture before
        speed_m_s : of the subject as estimated; of one who stands it errs by 0.5 m/s, and by 1 m/s for a moment
        """
        seen = self.corrected(sight)
        if self._covariance[0, 0] == 0.0:
            self._state[:2], self._covariance[[0, 1], [0, 1]] = place + seen, 1e4
        # The way of one who walks at 0.9 m/s is no error of range and heading: 1 m in a second.
        walked_m2 = seconds * min(speed_m_s / 0.9, 2.0) ** 12
        self._covariance[[0, 1], [0, 1]] += walked_m2
        expected, (scale, heading) = self._state[:2] - place, self._state[2:4]
        # Between both: the noise of what is seen would shrink the scale, and that of the place stretch it.
        middle, off = 0.5 * (expected + seen), np.array([*(expected - seen), -heading])
        show = np.zeros((3, 5))
        show[:2, :2], show[2, 3] = -np.eye(2), 1.0
        show[:2, 2], show[:2, 3] = middle / scale, [middle[1], -middle[0]]
        # The heading returns within its time.
        noise = [self._noise * _LASTS_S] * 2 + [self._usual[1] ** 2 * 2.0 * _HEADING_S]
        spread = show @ self._covariance @ show.T + np.diag(noise) / max(seconds, 1e-3)
        gain = np.linalg.solve(spread, show @ self._covariance).T
        self._state = self._state + gain @ off
        covariance = self._covariance - gain @ show @ self._covariance
        self._covariance = 0.5 * (covariance + covariance.T)
        share = 1.0 - math.exp(-seconds / 10.0)
        self._noise = max(self._noise + share * (0.5 * float(off[:2] @ off[:2]) - self._noise), _LEAST_M**2)
        most = 2.0 * self._usual[0]  # two standard deviations of the range by body size
        self._state[2:4] = np.clip(self._state[2:4], [1.0 - most, -_MOST_RAD], [1.0 + most, _MOST_RAD])


_BEARING_NOISE = 0.01  # share of the range
_NOISE_M = 0.04  # of a place, whatever its range
#: m/s over the square of the seconds for which he recedes, far and near: the speed at which he may be followed.  A body
#: that swings or crouches shrinks too, for a second or two.
_AWAY_FAR, _AWAY_NEAR = 0.14, 0.3
#: m, where the distance begins to count and where it counts whole: an error of the size is an error of the speed in
#: proportion to the distance.
_NEAR_M, _FAR_M = 8.0, 12.0
#: (4, 4): a place and a velocity that stay, and by the second what the velocity adds to the place.
_STAYS, _MOVES = np.eye(4), np.eye(4, k=2)


class Guard:
    """An estimate of the subject of its own.  It reads no clock."""

    def __init__(self, config: SubjectConfig) -> None:
        self._config = dataclasses.replace(config, use_ground_plane=False)
        self._size_error = config.size_error
        self._state: np.ndarray | None = None  # (4,) m, m/s ENU: the last sure place and the velocity there
        self._covariance = np.eye(4)
        self._stamp_ns, self._track_id, self._contradicted = 0, 0, False
        self._away = 0.0  # m/s, at which he has walked away for long enough

    def see(
        self, observation: PoseObservation, camera_matrix: np.ndarray, camera: CameraPose | None, *, locked: bool
    ) -> bool:
        """Take one image's keypoints; returns whether they show the subject where he can be.

        locked : the vehicle flies, so neither another track nor a far place may become the sure one
        """
        if camera is None:
            return False
        found = locate_subject(observation, camera_matrix, camera, self._config)
        if found is None:
            return False
        if self._is_he(found, observation, camera.position[:2], locked=locked):
            self._stamp_ns, self._contradicted = observation.stamp_ns, False
            return True
        self._contradicted = self._contradicted or observation.stamp_ns > self._stamp_ns
        return False

    def _is_he(
        self, found: SubjectMeasurement, observation: PoseObservation, camera: np.ndarray, *, locked: bool
    ) -> bool:
        """Begin with a place, or take it; returns whether the subject can be there."""
        gap_s, other = (observation.stamp_ns - self._stamp_ns) / NS, observation.track_id != self._track_id
        # After a second without a sure image any image is sure, unless the vehicle flies by him.
        if self._state is None or (not locked and (other or abs(gap_s) > 1.0)):
            self._start(found.position[:2], observation)
            return True
        if gap_s <= 0 or other:
            return False
        sure = self._correct(found.position[:2], camera, gap_s, 1.0 if found.bending < MAX_BENDING else BENT)
        self._learn_away(camera, gap_s)
        return sure

    def sight(self, vehicle: np.ndarray, offset: np.ndarray, now_ns: int) -> SizeSight | None:
        """The subject as the vehicle sees him now; None = no image had a size yet.

        vehicle : (3,) m, in the frame of the reported position
        offset : (3,) m, from the frame of the camera's poses to that one
        """
        if self._state is None:
            return None
        age_s = (now_ns - self._stamp_ns) / NS
        state, covariance = self._predicted(min(max(age_s, 0.0), 0.5))
        sight = state[:2] + offset[:2] - vehicle[:2]
        distance = max(float(np.hypot(*sight)), 1e-3)
        toward = sight / distance
        sd = math.sqrt(max(float(toward @ covariance[:2, :2] @ toward), 0.0))
        return SizeSight(
            distance_m=distance,
            toward=toward,
            nearest_m=(1 - 2 * self._size_error) * distance,
            farthest_m=(1 + 2 * self._size_error) * distance + 2 * sd,
            receding_m_s=min(self._receding(toward, (state, covariance)), self._away),
            age_s=age_s,
            contradicted=self._contradicted,
        )

    def _start(self, place: np.ndarray, observation: PoseObservation) -> None:
        self._state = np.concatenate([place, np.zeros(2)])
        self._covariance, self._away = np.eye(4), 0.0
        self._track_id = observation.track_id

    def _correct(self, place: np.ndarray, camera: np.ndarray, gap_s: float, bent: float) -> bool:
        """Take a place, unless the subject cannot be there."""
        state, covariance = self._predicted(gap_s)
        sight = place - camera
        distance = float(np.hypot(*sight))
        along = sight / max(distance, 1e-6)
        across = np.array([-along[1], along[0]])
        basis = np.stack([along, across])
        radial = bent * SIZE_NOISE * distance + _NOISE_M
        noise = np.diag([radial, _BEARING_NOISE * distance + _NOISE_M]) ** 2
        innovation = basis @ (place - state[:2])
        spread = basis @ covariance[:2, :2] @ basis.T + noise
        usual = 2 * math.sqrt(spread[0, 0])
        surprise = max(abs(innovation[0]) - usual, 0.0)
        # Four standard deviations across the sight, a third of the range along it.
        if abs(innovation[1]) > 4.0 * math.sqrt(spread[1, 1]) or surprise > 0.35 * distance:
            return False
        spread[0, 0] += surprise**2
        gain = covariance[:, :2] @ basis.T @ np.linalg.inv(spread)
        self._state = state + gain @ innovation
        covariance = covariance - gain @ basis @ covariance[:2]
        self._covariance = 0.5 * (covariance + covariance.T)
        return True

    def _learn_away(self, camera: np.ndarray, gap_s: float) -> None:
        assert self._state is not None
        sight = self._state[:2] - camera
        distance = float(np.hypot(*sight))
        receding = self._receding(sight / max(distance, 1e-3), (self._state, self._covariance))
        growth = _AWAY_NEAR + farness(distance) * (_AWAY_FAR - _AWAY_NEAR)
        receding_s = math.sqrt(self._away / growth) + min(gap_s, 0.5)
        self._away = max(min(receding, growth * receding_s**2), 0.0)

    def _predicted(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        assert self._state is not None
        move = _STAYS + dt * _MOVES
        push = 0.5 * dt * dt * _STAYS[:, :2] + dt * _STAYS[:, 2:]
        # m/s^2, of the subject's velocity in a second.
        noise = 0.7**2 / max(dt, 1e-3) * push @ push.T
        return move @ self._state, move @ self._covariance @ move.T + noise

    def _receding(self, inward: np.ndarray, estimate: tuple[np.ndarray, np.ndarray]) -> float:
        """Speed (m/s) at which the subject walks away by his image, negative towards the vehicle; 0 = not sure."""
        state, covariance = estimate
        speed = float(state[2:] @ inward)
        sd = math.sqrt(max(float(inward @ covariance[2:, 2:] @ inward), 0.0))
        # Half a standard deviation is left out.
        return math.copysign(max(abs(speed) - 0.5 * sd, 0.0), speed)


def farness(distance_m: float) -> float:
    """How much of a far subject's errors counts, 0 to 1: his receding is less sure."""
    return min(max((distance_m - _NEAR_M) / (_FAR_M - _NEAR_M), 0.0), 1.0)
