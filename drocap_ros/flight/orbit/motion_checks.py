"""The conditions for motion, in the order in which they are checked; each check returns the first one that fails."""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import supported_titles
from drocap_ros.flight.autopilot.autopilot import LossAction, LossSettings
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, OrbitConfig, SafetyConfig
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.flight.observed import FIX_3D, Observed
from drocap_ros.flight.vehicle import LANDED_IN_AIR, LANDED_LANDING, LANDED_ON_GROUND, LANDED_TAKEOFF

_C = ConditionCode
REACTION_S = 0.5  # from a step of the subject until the vehicle slows down
OWN_SPEED_SD_M_S = 0.1  # of the reported velocity
WAITING_LEADS = 1.3  # of max_lead_m: beyond it the reference stands
GUST_S = 1.0  # away for so long: a gust passes
_LONGEST_AWAY_S = 20.0  # behind walking subjects in 8 m/s of wind: 10 s
_FUTURE_S = 0.2  # the clocks of image and step differ by a transmission at most
#: MAV_STATE of a vehicle that nobody should command; the first may stand for stopped motors.
_EMERGENCIES = {
    mavlink.MAV_STATE_EMERGENCY: "an emergency",
    mavlink.MAV_STATE_POWEROFF: "that it is shutting down",
    mavlink.MAV_STATE_FLIGHT_TERMINATION: "that the flight is terminated",
}
LANDED_STATES = {LANDED_ON_GROUND: "on the ground", LANDED_TAKEOFF: "taking off", LANDED_LANDING: "landing"}


def vehicle_condition(seen: Observed, config: MavlinkBridgeConfig, *, patient: bool = False) -> Condition | None:
    """Why the vehicle must not be commanded; None = it may.

    patient : of an orbit that is flown: gaps of telemetry slow it down before they end it
    """
    if not config.commands_enabled:
        return condition(_C.COMMANDS_DISABLED)
    # What has come while our own loop stood waits to be read.
    oldest_s = oldest_state_s(config, patient=patient) + (seen.stalled_s if patient else 0.0)
    silent = 0.0 < config.operator_timeout_s < seen.operator_age_s
    return (
        seen.disturbance
        or (stalled_condition(seen) if seen.stalled_s and not patient else None)
        or _autopilot_condition(seen, config, oldest_s)
        or _state_condition(seen, config, oldest_s)
        or _health_condition(seen, config)
        or battery_condition(seen.health.battery_fraction, seen.health.battery_voltage_v, config)
        or seen.pictures.camera_problem
        or seen.intruder
        or (condition(_C.OPERATOR_SILENT, age_s=seen.operator_age_s) if silent else None)
    )


def stalled_condition(seen: Observed) -> Condition:
    """That our own loop stood still."""
    return condition(_C.CONTROL_LOOP_STALLED, gap_s=seen.stalled_s)


def _autopilot_condition(seen: Observed, config: MavlinkBridgeConfig, oldest_s: float) -> Condition | None:
    """Whether an autopilot is heard that the bridge flies, and whose setting for the loss of setpoints is safe."""
    if seen.link.age_s > oldest_s:
        return condition(_C.LINK_SILENT, age_s=seen.link.age_s)
    if not seen.autopilot.supported:
        return condition(_C.AUTOPILOT_UNSUPPORTED, autopilot=seen.autopilot_name, supported=supported_titles())
    return loss_condition(seen.loss_settings, seen.autopilot.loss_action, config.max_control_timeout_s)


def _state_condition(seen: Observed, safety: SafetyConfig, oldest_s: float) -> Condition | None:
    """Whether mode, attitude and position are known and fresh."""
    vehicle, link = seen.vehicle, seen.link
    for age_s, limit_s, code in (
        (link.heartbeat_age_s, safety.max_heartbeat_age_s, _C.MODE_OUTDATED),
        (vehicle.age_s, oldest_s, _C.ATTITUDE_OUTDATED),
        (vehicle.position_age_s, oldest_s, _C.POSITION_FROZEN),
        (link.round_trip_s, safety.max_round_trip_s, _C.ROUND_TRIP_TOO_LONG),
    ):
        if age_s > limit_s:
            return condition(code, age_s=age_s)
    return None if vehicle.known else condition(_C.VEHICLE_STATE_UNKNOWN)


def _health_condition(seen: Observed, safety: SafetyConfig) -> Condition | None:
    """Whether the vehicle flies, and is well by its own account, which is fresh."""
    health = seen.health
    if not health.armed:
        return condition(_C.NOT_ARMED)
    unsure = seen.autopilot.starts_from_ground and health.landed_state != LANDED_IN_AIR
    if health.landed_state in LANDED_STATES or unsure:
        landed = LANDED_STATES.get(health.landed_state, "not reported to be in the air (EXTENDED_SYS_STATE)")
        return condition(_C.NOT_FLYING, landed_state=landed)
    if health.system_status in _EMERGENCIES:
        return condition(_C.AUTOPILOT_EMERGENCY, reported=_EMERGENCIES[health.system_status])
    if health.gps_fix_type < FIX_3D:
        return condition(_C.NO_SATELLITE_FIX, fix_type=health.gps_fix_type)
    if not health.position_ok:
        return condition(_C.ESTIMATOR_UNHEALTHY)
    return condition(_C.STATUS_OUTDATED, age_s=health.age_s) if health.age_s > safety.max_status_age_s else None


def start_condition(seen: Observed) -> Condition | None:
    """Why no orbit may begin; one that is flown goes on.

    A critical state is reported after a failsafe of battery, radio or ground station has triggered, or while one acts.
    That for the loss of setpoints is our own, and ends with them: the hold that it flies while the control mode is
    still intended forbids nothing.  Nothing but setpoints is sent in it, so where another failsafe flies the same hold,
    the autopilot does not leave it.
    Of several vehicles the first one that was heard would fly, and need not be the one with the camera.
    """
    if len(seen.link.vehicles) > 1:
        return condition(_C.SEVERAL_VEHICLES, systems=", ".join(map(str, sorted(seen.link.vehicles))))
    own_loss = seen.mode.left_by_itself and seen.mode.in_hold
    if seen.health.system_status == mavlink.MAV_STATE_CRITICAL and not own_loss:
        return condition(_C.AUTOPILOT_CRITICAL, reported="a critical state")
    return contradicted_height(seen) if seen.vehicle.known else None


def battery_condition(charge: float, volts: float, safety: SafetyConfig) -> Condition | None:
    """Why the battery forbids motion: its charge (0 to 1), and its voltage where a least one is configured."""
    least_v = safety.min_battery_voltage_v
    if least_v > 0 and volts < least_v:
        return condition(_C.BATTERY_LOW, level=f"{volts:.1f} V")
    if charge < safety.min_battery_fraction:
        return condition(_C.BATTERY_LOW, level=f"{100 * charge:.0f} %")
    if math.isnan(volts if least_v > 0 else charge):
        return condition(_C.BATTERY_UNKNOWN)
    return None


def loss_condition(settings: LossSettings | None, meaning: LossAction | None, longest_s: float) -> Condition | None:
    """Why the autopilot's reaction to the loss of setpoints forbids motion; ``longest_s`` 0 = not checked.

    meaning : of the action's number; None = the autopilot has no such setting
    """
    if settings is None or longest_s == 0:
        return None
    if math.isnan(settings.timeout_s):
        return condition(_C.TIMEOUT_UNKNOWN, name=settings.timeout_name, limit_s=longest_s)
    if settings.timeout_s > longest_s * ROUNDING:  # it is float32
        return condition(_C.TIMEOUT_TOO_LONG, name=settings.timeout_name, value_s=settings.timeout_s, limit_s=longest_s)
    if meaning is None:
        return None
    unknown = "the vehicle reacts in an unknown way" if math.isnan(settings.action) else ""
    if consequence := unknown or meaning.fatal.get(int(settings.action), ""):
        return condition(
            _C.LOSS_ACTION_FATAL,
            name=meaning.setting,
            value=settings.action,
            consequence=consequence,
            hold=meaning.hold,
        )
    return None


def limit_condition(seen: Observed, fence_centre: np.ndarray | None, config: MavlinkBridgeConfig) -> Condition | None:
    """Which limit of place or speed is reached, the braking distance included; the vehicle's state must be known."""
    speed = math.sqrt(seen.vehicle.velocity @ seen.vehicle.velocity)
    if speed > config.speed_margin * config.max_speed_m_s:
        return condition(_C.TOO_FAST, speed_m_s=speed)
    climb = float(seen.vehicle.velocity[2])
    margin = braking_distance(climb, config)
    height_m = seen.vehicle.height.m
    if height_m + (margin if climb > 0 else 0.0) > config.max_height_m:
        return condition(_C.TOO_HIGH, height_m=height_m, limit_m=config.max_height_m)
    if (contradicted := contradicted_height(seen, lower=True)) is not None:
        return contradicted
    source, lowest = min(seen.heights.items(), key=lambda row: row[1].m, default=("unknown", seen.vehicle.height))
    if not lowest.m - (margin if climb < 0 else 0.0) >= config.min_height_m:
        return condition(_C.TOO_LOW, height_m=lowest.m, source=source, limit_m=config.min_height_m)
    if fence_centre is not None:
        offset = seen.vehicle.position[:2] - fence_centre
        distance = float(np.hypot(*offset))
        outward = max(float(offset @ seen.vehicle.velocity[:2]) / max(distance, 1e-6), 0.0)
        if distance + braking_distance(outward, config) > config.fence_radius_m:
            return condition(_C.AT_FENCE, distance_m=distance, limit_m=config.fence_radius_m)
    return None


def contradicted_height(seen: Observed, *, lower: bool = False) -> Condition | None:
    """Whether another source contradicts the reported height beyond what the two err by.

    lower : by a lower one alone: a body that looks small for its posture seems to be farther below the camera
    """
    reported = seen.vehicle.height
    for source, height in seen.heights.items():
        surplus = (reported.m - height.m) / math.hypot(reported.sd_m, height.sd_m)
        if (surplus if lower else abs(surplus)) > 3.0:  # standard deviations
            return condition(_C.HEIGHT_CONTRADICTED, height_m=reported.m, source=source, other_m=height.m)
    return None


def keeping_condition(
    seen: Observed, config: MavlinkBridgeConfig, longest_s: float = _LONGEST_AWAY_S
) -> Condition | None:
    """Why the vehicle counts as unable to keep the orbit, after ``longest_s`` away from its place; None = it is not.

    Sooner at three times the distance: the vehicle is carried off.
    """
    limit_m = away_limit_m(config)
    # Beyond the 3.7 m that vehicles were behind walking subjects.
    carried_off = seen.course.away_m > 3.0 * limit_m
    if carried_off:
        longest_s = min(longest_s, GUST_S)
    if seen.course.away_s <= longest_s:
        return None
    # A reversed orbit, a gust and a subject who turns leave a healthy vehicle behind for some seconds.
    verdict = f"the orbit waits for it, and ends after {_LONGEST_AWAY_S:g} s"
    if carried_off or seen.course.away_s > _LONGEST_AWAY_S:
        verdict = "it cannot keep the orbit in this wind, or follow this subject; land, or take over by hand"
    return condition(
        _C.ORBIT_NOT_KEPT, away_m=seen.course.away_m, for_s=seen.course.away_s, limit_m=limit_m, verdict=verdict
    )


def away_limit_m(orbit: OrbitConfig) -> float:
    """Distance from its place on the orbit beyond which the reference stands and waits for the vehicle."""
    return WAITING_LEADS * orbit.max_lead_m


def subject_condition(seen: Observed, config: MavlinkBridgeConfig, *, patient: bool = False) -> Condition | None:
    """Why the subject's position does not allow motion; None = it does.

    patient : of an orbit that is flown: late pictures slow it down, and stop it, before they end it; pictures of
        something else end it as before
    """
    if seen.subject.position is None:
        return condition(_C.NO_SUBJECT if seen.pictures.calibrated else _C.NO_CAMERA_INFO)
    oldest_s = oldest_subject_s(seen, config)
    if patient and not seen.subject.contradicted:
        oldest_s = max(oldest_s, config.max_subject_gap_s)
    if not -_FUTURE_S < seen.subject.age_s <= oldest_s:
        return outdated_condition(seen, oldest_s)
    if not seen.subject.sd_m <= config.max_subject_sd_m:
        return condition(_C.SUBJECT_UNCERTAIN, sd_m=seen.subject.sd_m)
    near, room_m = seen.subject, stopping_room(seen, config)
    if not near.distance_m - room_m >= config.min_distance_m:
        values = {"distance_m": near.distance_m, "sd_m": near.sd_m, "limit_m": config.min_distance_m}
        return condition(_C.SUBJECT_NEAR, room_m=room_m, **values)
    if seen.subject.distance_m > config.max_distance_m:
        return condition(_C.SUBJECT_FAR, distance_m=seen.subject.distance_m, limit_m=config.max_distance_m)
    return None


def outdated_condition(seen: Observed, oldest_s: float) -> Condition:
    """What is wrong with the pictures where the subject's position is older than ``oldest_s``.

    Where the newest picture itself is too old, the greater part of its age says why: it came late, or none came since.
    A newer one waits for the vehicle's attitude at its exposure, repeats the one before, shows something else in the
    subject's place, or does not show him.
    """
    pictures, age_s = seen.pictures, seen.subject.age_s
    if pictures.age_s > oldest_s:
        late_s = pictures.age_s - pictures.silent_s
        if pictures.silent_s > late_s or math.isinf(pictures.silent_s):
            return condition(_C.PICTURES_LOST, age_s=age_s, silent_s=pictures.silent_s)
        return condition(_C.PICTURES_LATE, age_s=age_s, late_s=late_s)
    if -_FUTURE_S < pictures.age_s < seen.vehicle.age_s:
        return condition(_C.ATTITUDE_OUTDATED, age_s=seen.vehicle.age_s)
    if pictures.frozen:
        return condition(_C.PICTURES_FROZEN, age_s=age_s)
    return condition(_C.OTHER_SUBJECT if seen.subject.contradicted else _C.SUBJECT_OUTDATED, age_s=age_s)


def stopping_room(seen: Observed, safety: SafetyConfig) -> float:
    """Distance (m) that may be lost between vehicle and subject until the vehicle stands, uncertainty included.

    A subject that recedes may stand in truth: what the vehicle flies towards him counts whole, and at least the speed
    at which it follows him.  One that comes nearer cannot be stopped: his steps count until the vehicle stands, less
    the way that it flies away from him until it reacts.  A standard deviation of his position, and of his speed until
    the vehicle reacts, is added.
    """
    closing_m_s, approach_m_s = seen.subject.closing_m_s, seen.subject.approach_m_s
    toward = max(closing_m_s, -approach_m_s, 0.0) + OWN_SPEED_SD_M_S  # own speed and chase together
    gaining = approach_m_s + min(closing_m_s, 0.0)  # on a vehicle that flies away
    steps = max(gaining, 0.0) * REACTION_S + max(approach_m_s, 0.0) * toward / safety.braking_m_s2
    unsure = math.hypot(seen.subject.sd_m, REACTION_S * seen.subject.approach_sd_m_s)
    return braking_distance(toward, safety) + steps + unsure


def oldest_state_s(safety: SafetyConfig, *, patient: bool = False) -> float:
    """Greatest age in s of attitude, position and link; ``patient`` as in :func:`vehicle_condition`."""
    return max(safety.max_state_age_s, safety.max_state_gap_s if patient else 0.0)


def oldest_subject_s(seen: Observed, safety: SafetyConfig) -> float:
    """Greatest age in s of the subject at which the vehicle is moved: less at speed."""
    velocity = seen.vehicle.velocity
    velocity = velocity if np.isfinite(velocity).all() else np.nan_to_num(velocity)
    speed = math.sqrt(velocity @ velocity)
    # At least the usual age of a picture at 15 Hz, its network included.
    return min(safety.max_subject_age_s, max(safety.max_blind_m / max(speed, 1e-3), 0.25))


def subject_located(seen: Observed, safety: SafetyConfig) -> bool:
    """Whether a subject is known recently and certainly enough to retreat from it."""
    recent = -_FUTURE_S < seen.subject.age_s <= safety.max_subject_age_s
    return seen.subject.position is not None and recent and seen.subject.sd_m <= safety.max_subject_sd_m


def braking_distance(speed_m_s: float, config: SafetyConfig) -> float:
    """Braking distance in m at the assumed deceleration."""
    return speed_m_s * speed_m_s / (2 * config.braking_m_s2)
