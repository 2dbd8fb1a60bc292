"""The orbit around a moving subject: a pure function of state and time.

A reference point circles a smoothed centre; the setpoint is that point with its velocity and acceleration
(centripetal ``-omega^2 R r_hat`` included) and a yaw from the vehicle's *actual* place to the subject.  The
reference waits for a vehicle that lags behind.  Angular speed, radius and height change along ramps limited in
acceleration and jerk.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.autopilot.coasting import Setpoint
from drocap_ros.flight.bridge_config import FLIGHT_ERROR_M, OrbitConfig, OrbitGoal
from drocap_ros.flight.orbit.motion_checks import REACTION_S
from drocap_ros.flight.orbit.speed import allowed_angular_speed, approach_speed, waiting
from drocap_ros.flight.subject.subject_filter import STANDING_M_S, WALKING_M_S

_CENTRE_RATE = 3.0  # 1/s; a slower centre is an error of the radius, a faster one passes on the estimate's noise
_FORWARD = 0.5  # m/s^2: most of it that is passed on, from 1 m/s beyond one who stands: slower, it is noise
_MAX_HASTE = 0.12  # m/s^2 along the path that the setpoint passes on: the reference waits for a vehicle that lags


class Ramp(NamedTuple):
    """A value with its rate and the change of that."""

    value: float
    rate: float = 0.0
    acceleration: float = 0.0


class OrbitState(NamedTuple):
    """State of the reference.

    phase : rad, bearing of the reference from the centre, from east
    omega : rad/s with its rate
    radius, height : m; height in the map frame
    centre, centre_velocity, centre_acceleration : (2,) m, m/s, m/s^2; the acceleration filtered
    trim : m, added to the radius: integrated mean radius error (wind, lag)
    flown_s : time of the reference
    goal_radius : m, of the goal, or of the wider orbit that is flown for it
    """

    phase: float
    omega: Ramp
    radius: Ramp
    height: Ramp
    centre: np.ndarray
    centre_velocity: np.ndarray
    centre_acceleration: np.ndarray
    trim: float = 0.0
    flown_s: float = 0.0
    goal_radius: float = 0.0


def least_radius(
    config: OrbitConfig,
    subject_sd_m: float,
    subject_speed_m_s: float,
    braking_m_s2: float,
    size_error: float = 0.0,
    nearer_m: float = 0.0,
) -> float:
    """Radius (m) at which an orbit stays clear of the minimum distance, whatever is wrong with the range.

    It includes two standard deviations of the subject's position, the worst error of a range by body size, what one of
    two ranges says beyond the other, and a walking subject that turns towards the vehicle or stops at once.

    size_error : standard deviation of the range by body size, a share
    nearer_m : by so much the nearer of body size and ground puts the subject nearer
    """
    speed = min(max(subject_speed_m_s - STANDING_M_S, 0.0), config.max_subject_speed_m_s)
    surprise = max(REACTION_S * speed, speed**2 / (2 * braking_m_s2))
    # A range errs by five of them at worst: by 40 % where the body is not measured, as by a wrong lens or a child.
    worst = 5.0 * size_error * config.min_distance_m
    nearer = max(2 * subject_sd_m, nearer_m + subject_sd_m, worst)
    return config.min_distance_m + nearer + surprise + FLIGHT_ERROR_M


def begin_orbit(vehicle: np.ndarray, subject: np.ndarray, config: OrbitConfig) -> OrbitState:
    """Reference at the vehicle's own position, so that no setpoint jumps at the start.

    vehicle, subject : (3,) ENU
    """
    offset = vehicle[:2] - subject[:2]
    return OrbitState(
        phase=math.atan2(offset[1], offset[0]),
        omega=Ramp(0.0),
        radius=Ramp(max(float(np.hypot(*offset)), config.min_distance_m)),
        height=Ramp(float(vehicle[2])),
        centre=subject[:2].copy(),
        centre_velocity=np.zeros(2),
        centre_acceleration=np.zeros(2),
    )


class Scene(NamedTuple):
    """Actual place of the vehicle, place and velocity of the subject: (3,) ENU; height of his ground in the map frame.

    least_radius_m : lower bound of the radius
    greatest_speed_m_s : of the vehicle, beside ``max_speed_m_s``
    """

    vehicle: np.ndarray
    subject: np.ndarray
    subject_velocity: np.ndarray
    ground_m: float = 0.0
    least_radius_m: float = 0.0
    greatest_speed_m_s: float = math.inf


def advance(state: OrbitState, goal: OrbitGoal, scene: Scene, dt: float, config: OrbitConfig) -> OrbitState:
    """The reference ``dt`` seconds later (at most 0.2 s of them)."""
    vehicle, subject, subject_velocity, ground_m, least_radius_m, greatest_speed_m_s = scene
    dt = min(max(dt, 0.0), 0.2)
    if dt == 0.0:
        return state
    goal = goal._replace(angular_speed_rad_s=sense(config, state.flown_s) * goal.angular_speed_rad_s)
    followed = _follow(state, subject[:2], subject_velocity[:2], dt, config)
    centre, centre_velocity, _ = followed
    jerk = config.max_jerk_m_s3
    slow = min(0.5 * config.max_acceleration_m_s2, 1.0)
    outward = np.array([math.cos(state.phase), math.sin(state.phase)])
    approach = approach_speed(state.radius.value, max(-float(state.centre_velocity @ outward), 0.0), config)
    goal_radius = max(goal.radius_m, config.min_distance_m, min(least_radius_m, config.max_distance_m))
    radius = _toward(state.radius, goal_radius, approach, slow, jerk, dt)
    height = _toward(state.height, ground_m + goal.height_m, config.approach_speed_m_s, slow, jerk, dt)
    moving = centre_velocity + radius.rate * outward
    along = math.copysign(1.0, goal.angular_speed_rad_s) * np.array([-outward[1], outward[0]])
    greatest = min(greatest_speed_m_s, config.max_speed_m_s)
    target = allowed_angular_speed(goal.angular_speed_rad_s, radius.value, moving, along, greatest, config)
    fastest = min(abs(goal.angular_speed_rad_s), greatest / radius.value)
    lead = float(np.linalg.norm(reference_position(state)[:2] - vehicle[:2]))
    waits, creep = waiting(lead, config.max_lead_m)
    target *= waits
    # A ramp of the wanted length with rounded ends: its greatest rate is 1.5 times its mean.
    rate = 1.5 * max(fastest, math.radians(5.0)) / config.ramp_s
    omega = _speed_toward(state.omega, target, rate, 6.0 * rate / config.ramp_s, dt)
    phase = state.phase + 0.5 * (state.omega.value + omega.value) * dt * creep
    if math.hypot(*centre_velocity) > WALKING_M_S:
        phase = _yielding(phase, vehicle[:2] - centre, config.max_lead_m / radius.value)
    trim = state.trim
    if creep == 1.0:
        error = radius.value - float(np.hypot(*(vehicle[:2] - subject[:2])))
        error = min(max(error, -1.0), 1.0)
        most = min(max(radius.value - least_radius_m, 0.0), FLIGHT_ERROR_M)  # no nearer than the least radius
        # 1/s: the turns of one who walks are no lasting error.
        rate = 0.15 if math.hypot(*centre_velocity) < WALKING_M_S else 0.03
        trim = min(max(trim + rate * error * dt, -most), FLIGHT_ERROR_M)
    phase = math.remainder(phase, 2 * math.pi)
    return OrbitState(phase, omega, radius, height, *followed, trim, state.flown_s + dt, goal_radius)


def sense(config: OrbitConfig, flown_s: float) -> float:
    """1, or -1 while the orbit is flown against its direction: a one-way orbit cannot separate yaw from latency."""
    if config.reverse_every_s > 0:
        return -1.0 if int(flown_s / config.reverse_every_s) % 2 else 1.0
    # The first 15 s go against the wanted direction.
    return -1.0 if config.calibrate_telemetry and flown_s < 15.0 else 1.0


def reference_position(state: OrbitState) -> np.ndarray:
    """(3,) m ENU, position of the reference."""
    c, s = math.cos(state.phase), math.sin(state.phase)
    r = state.radius.value + state.trim
    return np.array([state.centre[0] + r * c, state.centre[1] + r * s, state.height.value])


def setpoint_of(state: OrbitState, scene: Scene, config: OrbitConfig) -> Setpoint:
    """Setpoint of the reference, at most the greatest lead away from the vehicle."""
    vehicle, subject, subject_velocity = scene[:3]
    c, s = math.cos(state.phase), math.sin(state.phase)
    outward, along = np.array([c, s]), np.array([-s, c])
    r, omega = state.radius, state.omega
    walking = max(float(np.hypot(*state.centre_velocity)) - STANDING_M_S, 0.0)
    flat_velocity = state.centre_velocity + r.rate * outward + r.value * omega.value * along
    flat_acceleration = (
        _limited(state.centre_acceleration, _FORWARD * min(walking, 1.0))
        + (r.acceleration - omega.value**2 * r.value) * outward
        + (min(max(r.value * omega.rate, -_MAX_HASTE), _MAX_HASTE) + 2 * r.rate * omega.value) * along
    )
    velocity = _limited(np.array([*flat_velocity, state.height.rate]), config.max_speed_m_s)
    acceleration = _limited(np.array([*flat_acceleration, state.height.acceleration]), config.max_acceleration_m_s2)
    position = vehicle + _way(state, vehicle, config.max_lead_m)
    sight = subject[:2] - vehicle[:2]
    distance2 = max(float(sight @ sight), 0.25)
    # The subject moves as estimated, the vehicle as commanded.
    drift = subject_velocity[:2] - velocity[:2]
    yaw_rate = float(sight[0] * drift[1] - sight[1] * drift[0]) / distance2
    return Setpoint(position, velocity, acceleration, math.atan2(sight[1], sight[0]), yaw_rate)


def _yielding(phase: float, offset: np.ndarray, most: float) -> float:
    """Phase about a walking subject: where the vehicle cannot keep both, the angle yields, and the radius stays.

    A phase that stands is no waiting for the vehicle: the subject takes the reference with him, and its lead grows.

    offset : (2,) m, of the vehicle from the centre
    most : rad, from the vehicle's phase
    """
    bearing = math.atan2(offset[1], offset[0])
    return bearing + min(max(math.remainder(phase - bearing, 2 * math.pi), -most), most)


def _way(state: OrbitState, vehicle: np.ndarray, longest_m: float) -> np.ndarray:
    """(3,) m towards the reference: radius and height first, with what is left along the circle.

    The straight way would lead a vehicle that lags behind inside the circle, and its lag would take from the way that
    the radius has.
    """
    offset = vehicle[:2] - state.centre
    distance, bearing = math.hypot(*offset), math.atan2(offset[1], offset[0])
    outward = np.array([math.cos(bearing), math.sin(bearing), 0.0])
    along = np.array([-outward[1], outward[0], 0.0])
    radius = state.radius.value + state.trim
    first = _limited((radius - distance) * outward + [0.0, 0.0, state.height.value - vehicle[2]], longest_m)
    left = math.sqrt(max(longest_m**2 - float(first @ first), 0.0))
    arc = radius * math.remainder(state.phase - bearing, 2 * math.pi)
    return first + min(max(arc, -left), left) * along


def _follow(
    state: OrbitState, subject: np.ndarray, velocity: np.ndarray, dt: float, config: OrbitConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre that follows the subject: critically damped, limited in speed and acceleration against jumps."""
    pull = _CENTRE_RATE**2 * (subject - state.centre) + 2 * _CENTRE_RATE * (velocity - state.centre_velocity)
    # No subject accelerates by 8 m/s^2, so this limits only jumps.
    acceleration = _limited(pull, 8.0)
    moved = _limited(state.centre_velocity + acceleration * dt, config.max_subject_speed_m_s)
    change = (moved - state.centre_velocity) / dt
    # The centre's acceleration is filtered over half a second.
    filtered = state.centre_acceleration + (change - state.centre_acceleration) * min(dt / 0.5, 1.0)
    return state.centre + 0.5 * (state.centre_velocity + moved) * dt, moved, filtered


def _toward(ramp: Ramp, target: float, max_rate: float, max_acceleration: float, jerk: float, dt: float) -> Ramp:
    gap = target - ramp.value
    # Speed from which braking at half the acceleration ends at the target; linear near it.
    rate = min(max_rate, math.sqrt(0.7 * max_acceleration * abs(gap)), 0.8 * abs(gap))
    speed = _speed_toward(Ramp(ramp.rate, ramp.acceleration), math.copysign(rate, gap), max_acceleration, jerk, dt)
    return Ramp(ramp.value + 0.5 * (ramp.rate + speed.value) * dt, speed.value, speed.rate)


def _speed_toward(speed: Ramp, target: float, max_acceleration: float, jerk: float, dt: float) -> Ramp:
    """One step of a speed (value, its rate) towards a target, the rate and its change limited."""
    gap = target - speed.value
    rate = math.copysign(min(max_acceleration, math.sqrt(2 * jerk * abs(gap)), abs(gap) / dt, 4.0 * abs(gap)), gap)
    rate = speed.rate + min(max(rate - speed.rate, -jerk * dt), jerk * dt)
    return Ramp(speed.value + rate * dt, rate)


def _limited(vector: np.ndarray, length: float) -> np.ndarray:
    norm = math.sqrt(vector @ vector)
    return vector if norm <= length else vector * (length / norm)
