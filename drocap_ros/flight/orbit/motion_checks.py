"""The conditions for motion, in the order in which they are checked; each check returns the first one that fails."""

from __future__ import annotations

import math

import numpy as np

from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.autopilot_settings import LossSettings
from drocap_ros.flight.orbit.states import Limits, Observed
from drocap_ros.flight.safety_config import SafetyConfig
from drocap_ros.flight.vehicle_state import LANDED_LANDING, LANDED_ON_GROUND, LANDED_TAKEOFF

_C = ConditionCode
_REACTION_S = 0.5
_LEAST_SUBJECT_AGE_S = 0.25
_TIMEOUT_ROUNDING_S = 1e-3
#: The clocks of image and step differ by a transmission at most.
_FUTURE_S = 0.2
_LANDED_STATES = {LANDED_ON_GROUND: "on the ground", LANDED_TAKEOFF: "taking off", LANDED_LANDING: "landing"}
_FATAL_ACTIONS = {6: "flight is terminated", 7: "the motors are stopped"}


def vehicle_condition(seen: Observed, limits: Limits) -> Condition | None:
    """Why the vehicle must not be commanded; None = it may."""
    safety = limits.safety
    if not safety.commands_enabled:
        return condition(_C.COMMANDS_DISABLED)
    if seen.disturbance is not None:
        return seen.disturbance
    if seen.link_age_s > safety.max_state_age_s:
        return condition(_C.LINK_SILENT, age_s=seen.link_age_s)
    if seen.autopilot not in ("ardupilot", "px4"):
        return condition(_C.AUTOPILOT_UNSUPPORTED, autopilot=seen.autopilot)
    if (settings := loss_condition(seen.loss_settings, limits.max_control_timeout_s)) is not None:
        return settings
    if seen.heartbeat_age_s > safety.max_heartbeat_age_s:
        return condition(_C.MODE_OUTDATED, age_s=seen.heartbeat_age_s)
    if seen.state_age_s > safety.max_state_age_s:
        return condition(_C.ATTITUDE_OUTDATED, age_s=seen.state_age_s)
    if seen.position_age_s > safety.max_state_age_s:
        return condition(_C.POSITION_FROZEN, age_s=seen.position_age_s)
    if seen.round_trip_s > safety.max_round_trip_s:
        return condition(_C.ROUND_TRIP_TOO_LONG, age_s=seen.round_trip_s)
    if not (np.isfinite(seen.position).all() and np.isfinite(seen.velocity).all() and math.isfinite(seen.yaw)):
        return condition(_C.VEHICLE_STATE_UNKNOWN)
    if not seen.armed:
        return condition(_C.NOT_ARMED)
    if seen.landed_state in _LANDED_STATES:
        return condition(_C.NOT_FLYING, landed_state=_LANDED_STATES[seen.landed_state])
    if seen.gps_fix_type < 3:
        return condition(_C.NO_SATELLITE_FIX, fix_type=seen.gps_fix_type)
    if not seen.position_ok:
        return condition(_C.ESTIMATOR_UNHEALTHY)
    if seen.status_age_s > safety.max_status_age_s:
        return condition(_C.STATUS_OUTDATED, age_s=seen.status_age_s)
    if math.isnan(seen.battery_fraction):
        return condition(_C.BATTERY_UNKNOWN)
    if seen.battery_fraction < safety.min_battery_fraction:
        return condition(_C.BATTERY_LOW, percent=100 * seen.battery_fraction)
    return None


def loss_condition(settings: LossSettings | None, longest_s: float) -> Condition | None:
    """Why the autopilot's reaction to the loss of setpoints forbids motion; ``longest_s`` 0 = not checked."""
    if settings is None or longest_s == 0:
        return None
    if math.isnan(settings.timeout_s):
        return condition(_C.TIMEOUT_UNKNOWN, name=settings.timeout_name, limit_s=longest_s)
    if settings.timeout_s > longest_s + _TIMEOUT_ROUNDING_S:
        return condition(_C.TIMEOUT_TOO_LONG, name=settings.timeout_name, value_s=settings.timeout_s, limit_s=longest_s)
    if settings.action in _FATAL_ACTIONS:
        return condition(
            _C.LOSS_ACTION_FATAL, name=settings.action_name, value=settings.action,
            consequence=_FATAL_ACTIONS[int(settings.action)],
        )  # fmt: skip
    return None


def limit_condition(seen: Observed, fence_centre: np.ndarray | None, limits: Limits) -> Condition | None:
    """Which limit of place or speed is reached, the braking distance included; the vehicle's state must be known."""
    safety = limits.safety
    speed = float(np.linalg.norm(seen.velocity))
    if speed > safety.speed_margin * limits.orbit.max_speed_m_s:
        return condition(_C.TOO_FAST, speed_m_s=speed)
    climb = float(seen.velocity[2])
    margin = braking_distance(climb, safety)
    if seen.height_m + (margin if climb > 0 else 0.0) > safety.max_height_m:
        return condition(_C.TOO_HIGH, height_m=seen.height_m, limit_m=safety.max_height_m)
    if seen.height_m - (margin if climb < 0 else 0.0) < safety.min_height_m:
        return condition(_C.TOO_LOW, height_m=seen.height_m, limit_m=safety.min_height_m)
    if fence_centre is not None:
        offset = seen.position[:2] - fence_centre
        distance = float(np.hypot(*offset))
        outward = max(float(offset @ seen.velocity[:2]) / max(distance, 1e-6), 0.0)
        if distance + braking_distance(outward, safety) > safety.fence_radius_m:
            return condition(_C.AT_FENCE, distance_m=distance, limit_m=safety.fence_radius_m)
    return None


def subject_condition(seen: Observed, limits: Limits) -> Condition | None:
    """Why the subject's position does not allow motion; None = it does."""
    safety = limits.safety
    if seen.subject is None:
        return condition(_C.NO_SUBJECT)
    speed = float(np.linalg.norm(np.nan_to_num(seen.velocity)))
    oldest_s = min(safety.max_subject_age_s, max(safety.max_blind_m / max(speed, 1e-3), _LEAST_SUBJECT_AGE_S))
    if not -_FUTURE_S < seen.subject_age_s <= oldest_s:
        return condition(_C.SUBJECT_OUTDATED, age_s=seen.subject_age_s)
    if not seen.subject_sd_m <= safety.max_subject_sd_m:
        return condition(_C.SUBJECT_UNCERTAIN, sd_m=seen.subject_sd_m)
    if _too_near(seen, limits):
        return condition(
            _C.SUBJECT_NEAR, distance_m=seen.subject_distance_m, sd_m=seen.subject_sd_m,
            limit_m=limits.orbit.min_distance_m,
        )  # fmt: skip
    if seen.subject_distance_m > limits.orbit.max_distance_m:
        return condition(_C.SUBJECT_FAR, distance_m=seen.subject_distance_m, limit_m=limits.orbit.max_distance_m)
    return None


def _too_near(seen: Observed, limits: Limits) -> bool:
    # Braking takes the speed at which the distance shrinks.  A subject that walks towards the vehicle cannot be
    # stopped: its steps until a hold has begun count.  One that is followed may stop dead: its speed counts too.
    chase, approach = max(-seen.approach_m_s, 0.0), max(seen.approach_m_s, 0.0)
    own = max(seen.closing_m_s - chase, 0.0)
    room = braking_distance(own, limits.safety) + braking_distance(chase, limits.safety) + _REACTION_S * approach
    return not seen.subject_distance_m - room - seen.subject_sd_m >= limits.orbit.min_distance_m


def subject_located(seen: Observed, safety: SafetyConfig) -> bool:
    """Whether a subject is known recently and certainly enough to retreat from it."""
    recent = -_FUTURE_S < seen.subject_age_s <= safety.max_subject_age_s
    return seen.subject is not None and recent and seen.subject_sd_m <= safety.max_subject_sd_m


def braking_distance(speed_m_s: float, config: SafetyConfig) -> float:
    """Braking distance in m at the assumed deceleration."""
    return speed_m_s * speed_m_s / (2 * config.braking_m_s2)
