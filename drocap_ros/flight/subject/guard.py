"""The last check of the distance: the subject by image size and bearing alone, independent of filter and planner.

Neither the ground, nor the ratio of two ranges, nor the reference of the orbit enters.  An image that shows the subject
where he cannot be, since the last image that was sure, refreshes nothing: the age of that one counts, and the vehicle
slows down at once.

No setpoint moves faster towards the subject than ``max_closing_m_s``, and than leaves room to stop before
``min_distance_m`` if the body is smaller than assumed.  A subject who recedes may be followed as fast as his image
surely shrinks, and little faster than his estimated place recedes: while it keeps its size, following does not close.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from drocap_ros.flight.autopilot import autopilot_of
from drocap_ros.flight.orbit.pose_history import CameraPose
from drocap_ros.flight.orbit.states import Observed
from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.setpoint import Setpoint
from drocap_ros.flight.subject.subject_measurement import locate_subject
from drocap_ros.flight.subject_config import SubjectConfig
from drocap_ros.observation import PoseObservation

_NS = 1_000_000_000
_RADIAL_NOISE, _BEARING_NOISE, _NOISE_M = 0.06, 0.01, 0.04  # of one image: shares of the range, and m
_ACCELERATION = 0.7  # m/s^2: standard deviation of the change of the subject's velocity in a second
_MAX_BENDING, _BENT = 0.3, 4.0  # a bent body looks smaller: its size counts for less
_BEARING_GATE, _SIZE_GATE = 4.0, 0.35  # standard deviations across the sight; share of the range along it
_SURE = 0.5  # standard deviations of the speed at which he walks away that are left out
#: m/s over the square of the seconds for which he recedes, far and near: the speed at which he may be followed.  A body
#: that swings or crouches shrinks too, for a second or two.
_AWAY_FAR, _AWAY_NEAR = 0.14, 0.3
_RESTART_S = 1.0
_OVERSHOOT = 0.85  # of the greatest closing speed that a setpoint has: the vehicle overshoots
_SURELY_M_S = 0.1  # so much faster than by the estimated place he may recede by his image, which shrinks as he bends
#: m, and m/s that his receding must exceed at the second distance: an error of the size is an error of the speed in
#: proportion to the distance, and from 12 m one who stands recedes at up to 0.4 m/s for a second.
_NEAR_M, _FAR_M, _FAR_ERROR_M_S = 8.0, 12.0, 0.3
_POSITION_GAIN = 1.0  # 1/s, the greatest of the autopilots' position loops
_REACTION_S = 0.5
#: Most that a setpoint adds to the present closing speed towards one who stands, where setpoints are continued: the
#: vehicle overshoots a larger step.
_STEP_M_S = 0.4
#: Share of the speed at which such a vehicle follows a walker, by which it closes up more slowly: a stop is seen 0.4 s
#: late.
_STOPS = 0.3


class Guard:
    """An estimate of the subject of its own, and the limits that follow from it.  It reads no clock."""

    def __init__(self, subject: SubjectConfig, orbit: OrbitConfig, braking_m_s2: float) -> None:
        self._config = dataclasses.replace(subject, use_ground_plane=False)
        self._size_error, self._orbit, self._braking = subject.size_error, orbit, braking_m_s2
        self._state: np.ndarray | None = None  # (4,) m, m/s ENU: the last sure place and the velocity there
        self._covariance = np.eye(4)
        self._stamp_ns, self._track_id, self._contradicted = 0, 0, False
        self._last_keypoints: np.ndarray | None = None
        self._away = 0.0  # m/s, at which he has walked away for long enough
        self._offset, self._now_ns = np.zeros(3), 0

    def see(
        self, observation: PoseObservation, camera_matrix: np.ndarray, camera: CameraPose | None, *, locked: bool
    ) -> bool:
        """Take one image's keypoints; returns whether they show the subject where he can be.

        locked : the vehicle flies, so neither another track nor a far place may become the sure one
        """
        last, self._last_keypoints = self._last_keypoints, observation.keypoints
        frozen = last is not None and np.array_equal(last, observation.keypoints, equal_nan=True)
        known = camera is not None and not frozen and observation.has_subject
        found = locate_subject(observation, camera_matrix, camera, self._config) if known and camera else None
        other = observation.track_id != self._track_id
        sure = False
        if found is not None and camera is not None:
            gap_s = (observation.stamp_ns - self._stamp_ns) / _NS
            if self._state is None or (not locked and (other or abs(gap_s) > _RESTART_S)):
                self._start(found.position[:2], observation)
                sure = True
            elif gap_s > 0 and not other:
                bent = _BENT if not found.bending < _MAX_BENDING else 1.0
                sure = self._correct(found.position[:2], camera.position[:2], gap_s, bent)
                self._learn_away(camera.position[:2], gap_s)
        if sure:
            self._stamp_ns, self._contradicted = observation.stamp_ns, False
        elif found is not None and observation.stamp_ns > self._stamp_ns:
            self._contradicted = True
        return sure

    def doubt(self, seen: Observed, offset: np.ndarray, now_ns: int) -> Observed:
        """The observation, no surer of the subject than this estimate: its age, and the greatest distance of his size.

        offset : (3,) m, from the frame of the camera's poses to that of the reported position
        """
        self._offset, self._now_ns = offset, now_ns
        if seen.subject is None:
            return seen
        if self._state is None:  # too few joints for a size: without it nothing bounds the closing speed
            return dataclasses.replace(seen, subject_age_s=math.inf)
        distance, _, sd = self._sight(seen.position)
        farthest = (1 + 2 * self._size_error) * distance + 2 * sd
        return dataclasses.replace(
            seen, subject_contradicted=seen.subject_contradicted or self._contradicted,
            subject_age_s=max(seen.subject_age_s, (now_ns - self._stamp_ns) / _NS),
            subject_distance_m=min(seen.subject_distance_m, farthest),
        )  # fmt: skip

    def limit(self, setpoint: Setpoint, seen: Observed, receding_m_s: float = math.inf) -> Setpoint:
        """The setpoint that may be sent in the step of the last :meth:`doubt`.

        receding_m_s : speed at which the subject walks away by another estimate
        """
        if self._state is None:
            return setpoint
        distance, inward, _ = self._sight(seen.position)
        nearest = (1 - 2 * self._size_error) * distance
        room = math.sqrt(2 * self._braking * max(nearest - self._orbit.min_distance_m, 0.0))
        receding = min(self._receding(inward, self._now()), self._away)
        receding = min(receding, max(receding_m_s, 0.0) + _SURELY_M_S)
        receding = min(receding, max(receding - _farness(distance) * _FAR_ERROR_M_S, 0.0))
        closing_up = _OVERSHOOT * self._orbit.max_closing_m_s
        allowed = min(max(closing_up + receding, 0.0), room)
        if autopilot_of(seen.autopilot).continues_setpoints:
            closing = float(seen.velocity[:2] @ inward)
            allowed -= _STOPS * min(max(receding, 0.0), closing_up)
            # Its path, limited in jerk, overshoots a reversal: from 1.8 m/s away it closed up at 1.3 m/s without this.
            allowed += min(closing, 0.0)
            allowed = max(min(allowed, max(closing, 0.0) + _STEP_M_S + receding), 0.0)
        return _bounded(
            setpoint, seen.position, seen.velocity, inward, distance, allowed, self._orbit.max_acceleration_m_s2
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
        radial = bent * _RADIAL_NOISE * distance + _NOISE_M
        noise = np.diag([radial, _BEARING_NOISE * distance + _NOISE_M]) ** 2
        innovation = basis @ (place - state[:2])
        spread = basis @ covariance[:2, :2] @ basis.T + noise
        usual = 2 * math.sqrt(spread[0, 0])
        surprise = max(abs(innovation[0]) - usual, 0.0)
        if abs(innovation[1]) > _BEARING_GATE * math.sqrt(spread[1, 1]) or surprise > _SIZE_GATE * distance:
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
        growth = _AWAY_NEAR + _farness(distance) * (_AWAY_FAR - _AWAY_NEAR)
        receding_s = math.sqrt(self._away / growth) + min(gap_s, 0.5)
        self._away = max(min(receding, growth * receding_s**2), 0.0)

    def _predicted(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        assert self._state is not None
        move = np.eye(4)
        move[:2, 2:] = dt * np.eye(2)
        push = np.concatenate([0.5 * dt * dt * np.eye(2), dt * np.eye(2)])
        noise = _ACCELERATION**2 / max(dt, 1e-3) * push @ push.T
        return move @ self._state, move @ self._covariance @ move.T + noise

    def _sight(self, vehicle: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Distance (m), direction (2,) to the subject, standard deviation of the distance without that of the body."""
        state, covariance = self._now()
        sight = state[:2] + self._offset[:2] - vehicle[:2]
        distance = max(float(np.hypot(*sight)), 1e-3)
        inward = sight / distance
        return distance, inward, math.sqrt(max(float(inward @ covariance[:2, :2] @ inward), 0.0))

    def _receding(self, inward: np.ndarray, estimate: tuple[np.ndarray, np.ndarray]) -> float:
        """Speed (m/s) at which the subject walks away by his image, negative towards the vehicle; 0 = not sure."""
        state, covariance = estimate
        speed = float(state[2:] @ inward)
        sd = math.sqrt(max(float(inward @ covariance[2:, 2:] @ inward), 0.0))
        return math.copysign(max(abs(speed) - _SURE * sd, 0.0), speed)

    def _now(self) -> tuple[np.ndarray, np.ndarray]:
        return self._predicted(min(max((self._now_ns - self._stamp_ns) / _NS, 0.0), 0.5))


def _farness(distance_m: float) -> float:
    return min(max((distance_m - _NEAR_M) / (_FAR_M - _NEAR_M), 0.0), 1.0)


def _bounded(
    setpoint: Setpoint, position: np.ndarray, velocity: np.ndarray, toward: np.ndarray, distance: float,
    allowed_m_s: float, max_acceleration_m_s2: float,
) -> Setpoint:  # fmt: skip
    """The setpoint with no more speed towards the subject than allowed.

    The autopilot flies the setpoint's velocity and a share of the way to its position; their sum is bounded, at the
    cost of the position first.  Acceleration towards the subject turns the vehicle on its circle, and beyond that
    brings the present closing speed to the allowed one.
    """
    inward = np.append(toward, 0.0)
    ahead, speed = float((setpoint.position - position) @ inward), float(setpoint.velocity @ inward)
    excess = speed + _POSITION_GAIN * ahead - allowed_m_s
    place, flown = setpoint.position, setpoint.velocity
    if excess > 0:
        back = min(excess / _POSITION_GAIN, max(ahead, 0.0))
        place = place - back * inward
        flown = flown - min(excess - _POSITION_GAIN * back, max(speed, 0.0)) * inward
    closing = float(velocity @ inward)
    turning = max(float(velocity[:2] @ velocity[:2]) - closing**2, 0.0) / max(distance, 0.5)
    most = max(turning + (allowed_m_s - closing) / _REACTION_S, -max_acceleration_m_s2)
    acceleration = setpoint.acceleration - max(float(setpoint.acceleration @ inward) - most, 0.0) * inward
    size = float(np.linalg.norm(acceleration))
    acceleration = acceleration * min(1.0, max_acceleration_m_s2 / max(size, 1e-6))
    return setpoint._replace(position=place, velocity=flown, acceleration=acceleration)
