"""Parameters of the MAVLink bridge."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from drocap_ros.errors import ParameterError
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.parameters import Parameters, param

OPERATOR_PERIOD_S, LEAST_OPERATOR_S = 0.5, 1.5  # between two signs of the operator; least time without any
HEIGHT_ROOM_M = (0.3, 0.5)  # of an orbit from min_height_m and max_height_m: the error of its height


@dataclass(frozen=True)
class SafetyConfig(Parameters):
    """Limits within which motion may be commanded, and how motion ends."""

    commands_enabled: bool = param(False, "whether motion may be commanded at all")
    mode_change_allowed: bool = param(
        False, "whether the operator's `engage` may change the mode to GUIDED or OFFBOARD; `start` never does"
    )
    max_subject_age_s: float = param(
        0.4,
        "greatest age of the subject's position at which an orbit may begin; one that is flown slows down from "
        "0.24 s on, and its setpoints stand from 5/6 of this age, 0.33 s, on",
        "s",
        0.05,
        2,
    )
    max_subject_gap_s: float = param(
        1.0, "age of the subject's position beyond which an orbit that has slowed down ends by a hold", "s", 0.05, 5
    )
    max_blind_m: float = param(
        0.85, "greatest distance flown since the subject was located: it limits his age, to 0.25 s", "m", 0.1, 10
    )
    max_subject_sd_m: float = param(1.5, "greatest standard deviation of the subject's position", "m", 0.05, 10)
    max_state_age_s: float = param(
        0.2, "greatest age of the vehicle's attitude and position at full speed: 0.4 m at 2 m/s", "s", 0.05, 2
    )
    max_state_gap_s: float = param(
        0.4, "age of attitude or position beyond which an orbit, slowed down before, ends by a hold", "s", 0.05, 2
    )
    max_status_age_s: float = param(1.5, "greatest age of GPS, estimator and battery messages", "s", 0.3, 10)
    max_heartbeat_age_s: float = param(2.5, "greatest age of the flight mode", "s", 0.3, 10)
    max_round_trip_s: float = param(
        0.5, "greatest time since the sending of the message that the autopilot has answered last", "s", 0.02, 5
    )
    max_echo_age_s: float = param(
        0.5, "time without the autopilot's echo after which it counts as not following our setpoints", "s", 0.3, 10
    )
    min_battery_fraction: float = param(0.25, "least charge of the battery", minimum=0, maximum=1)
    min_battery_voltage_v: float = param(
        0.0, "least voltage of the battery in flight, also where no charge is reported; 0 = not used", "V", 0, 120
    )
    fence_radius_m: float = param(40.0, "greatest horizontal distance from where the orbit began", "m", 5, 1000)
    min_height_m: float = param(1.2, "least height above the subject's ground", "m", 0.3, 100)
    max_height_m: float = param(20.0, "greatest height above the subject's ground", "m", 1, 120)
    braking_m_s2: float = param(
        1.3, "assumed deceleration: the margin to every limit is v^2 / (2 of this)", "m/s^2", 0.2, 10
    )
    max_coast_m: float = param(
        3.0,
        "distance that the vehicle may fly on if setpoints end, the autopilot's time-out included: it limits the "
        "speed, to 1.3 to 1.8 m/s by the autopilot with a time-out of 0.5 s, up to 2.1 m/s with 0.3 s",
        "m",
        0.5,
        50,
    )
    speed_margin: float = param(
        1.3, "share of max_speed_m_s above which the vehicle is stopped", minimum=1.0, maximum=3.0
    )
    hold_s: float = param(
        3.0, "longest time of a moving vehicle's hold before the autopilot's hold mode is requested", "s", 0.5, 30
    )
    blind_hold_s: float = param(
        3.5, "longest hold while telemetry is silent or late: braking from 4.5 m/s takes 3.5 s", "s", 0.5, 30
    )
    max_orbit_s: float = param(
        1200.0,
        "longest time of an orbit, which then holds until the operator starts again; 0 = no limit",
        "s",
        0,
        36000,
    )
    operator_timeout_s: float = param(
        0.0,
        "longest time without a sign of the operator's console (`drocap orbit watch`), after which an orbit holds and "
        "none begins; at least 1.5 s; 0 = none is expected",
        "s", 0, 60,
    )  # fmt: skip
    engage_timeout_s: float = param(
        5.0, "time for the autopilot to enter GUIDED or OFFBOARD after `engage`", "s", 1, 30
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0.0 < self.operator_timeout_s < LEAST_OPERATOR_S:
            raise ParameterError(
                f"operator_timeout_s: expected 0 (none is expected) or at least {LEAST_OPERATOR_S:g} s, "
                f"got {self.operator_timeout_s:g}; the console gives a sign every {OPERATOR_PERIOD_S:g} s"
            )
        if self.max_height_m < self.min_height_m + 1.0:
            raise ParameterError(
                f"max_height_m: expected at least min_height_m and 1 m, {self.min_height_m + 1.0:g}, "
                f"got {self.max_height_m:g}; leave room to fly in"
            )


def height_condition(config: SafetyConfig, height_m: float) -> Condition | None:
    """Whether an orbit at this height leaves too little room to the limits; None = enough."""
    low, high = config.min_height_m + HEIGHT_ROOM_M[0], config.max_height_m - HEIGHT_ROOM_M[1]
    if low <= height_m * ROUNDING and height_m <= high * ROUNDING:
        return None
    return condition(ConditionCode.HEIGHT_OUT_OF_RANGE, value=height_m, low=low, high=high)


#: Kinds of mount: "auto" = as the autopilot describes it; "gimbal" = stabilized, its angles are against the horizon;
#: "servo" = its angles are against the body; "fixed" = no mount, the camera has one pitch against the body.
MOUNT_KINDS = ("auto", "gimbal", "servo", "fixed")


@dataclass(frozen=True)
class SubjectConfig(Parameters):
    """Assumptions about body, ground and sensors that locate the subject."""

    body_height_m: float = param(1.7, "assumed height of the subject", "m", 0.5, 2.5)
    ground_height_m: float = param(
        0.0,
        "CHANGE: height of the subject's ground in the autopilot's local frame, up: of the take-off place, as "
        "preflight reads it on the ground, and how much higher he stands",
        "m",
        -500,
        500,
    )
    use_ground_plane: bool = param(True, "use the range of the feet on level ground too; switch off on slopes")
    size_error: float = param(
        0.08,
        "standard deviation of the range from body size, as a share of it: 0.04 where body_height_m is measured",
        minimum=0.01,
        maximum=1,
    )
    height_error_m: float = param(
        0.5, "standard deviation of the camera's height above the subject's ground", "m", 0, 20
    )
    attitude_error_deg: float = param(0.6, "standard deviation of the camera's attitude", "deg", 0, 20)
    camera_latency_s: float = param(
        0.0, "exposure to stamp of an image, subtracted from it; 0.07 s were seen of USB cameras", "s", 0, 0.5
    )
    subject_acceleration_m_s2: float = param(
        1.2, "standard deviation of the change of a subject's velocity in a second", "m/s^2", 0.05, 20
    )
    subject_gate: float = param(
        16.3, "squared Mahalanobis distance beyond which a measurement is not the subject", minimum=3, maximum=1000
    )
    mount: str = param(
        "auto",
        "what holds the camera: gimbal = its angles are reported against the horizon; servo = reported against "
        "the body; fixed = camera_pitch_deg against the body; auto = gimbal, or servo where the autopilot names "
        "servos",
        choices=MOUNT_KINDS,
    )
    camera_pitch_deg: float = param(
        0.0, "pitch of a fixed camera against the body, as in MAVLink: negative = it looks down", "deg", -90, 90
    )


FLIGHT_ERROR_M = 0.5  # of the flown radius: an orbit's room from min_distance_m, and the most that is trimmed
LEAST_REVERSAL_S = 10.0  # a turn takes two ramps


@dataclass(frozen=True)
class OrbitConfig(Parameters):
    """The orbit that is flown unless a command changes it, and the limits of every orbit."""

    radius_m: float = param(6.0, "horizontal distance from the subject", "m", 0, 100)
    height_m: float = param(2.5, "height above the subject's ground", "m", 0, 100)
    angular_speed_deg_s: float = param(
        19.0, "angular speed, positive = counter-clockwise seen from above", "deg/s", -60, 60
    )
    min_distance_m: float = param(3.0, "least horizontal distance from the subject", "m", 1.0, 100)
    max_distance_m: float = param(
        20.0, "greatest horizontal distance from the subject at which an orbit may begin", "m", 2, 200
    )
    max_speed_m_s: float = param(4.5, "greatest speed asked of the vehicle", "m/s", 0.2, 15)
    max_acceleration_m_s2: float = param(
        2.0, "greatest acceleration asked of the vehicle; an orbit needs omega^2 radius", "m/s^2", 0.1, 5
    )
    max_jerk_m_s3: float = param(2.0, "greatest change of acceleration", "m/s^3", 0.1, 20)
    ramp_s: float = param(3.0, "time to reach the angular speed", "s", 0.5, 30)
    approach_speed_m_s: float = param(1.0, "speed of changes of radius and height", "m/s", 0.05, 5)
    max_closing_m_s: float = param(
        1.0, "greatest speed towards the subject, beside that at which his image surely shrinks", "m/s", 0.2, 5
    )
    max_subject_speed_m_s: float = param(
        2.5, "greatest speed at which the orbit's centre follows the subject", "m/s", 0, 10
    )
    max_lead_m: float = param(1.5, "greatest distance of the position setpoint from the vehicle", "m", 0.2, 10)

    reverse_every_s: float = param(
        0.0, "time between turns of the direction, which tell yaw from latency; 0 = never, else >= 10 s", "s", 0, 3600
    )
    calibrate_telemetry: bool = param(
        False,
        "whether the orbit begins against its direction and turns once, after 15 s, so that a reconstruction "
        "can calibrate the telemetry; reverse_every_s replaces it",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0.0 < self.reverse_every_s < LEAST_REVERSAL_S:
            raise ParameterError(
                f"reverse_every_s: expected 0 (never) or at least {LEAST_REVERSAL_S:g} s, "
                f"got {self.reverse_every_s:g}; "
                "a turn takes two ramps"
            )
        if (refusal := orbit_condition(self, self.radius_m, self.angular_speed_deg_s)) is not None:
            raise ParameterError(str(refusal))


def orbit_condition(config: OrbitConfig, radius_m: float, angular_speed_deg_s: float) -> Condition | None:
    """Which limit of ``config`` forbids this orbit; None = none."""
    least = config.min_distance_m + FLIGHT_ERROR_M
    if radius_m * ROUNDING < least:
        return condition(ConditionCode.RADIUS_TOO_SMALL, value=radius_m, limit=least)
    if radius_m > config.max_distance_m * ROUNDING:
        return condition(
            ConditionCode.RADIUS_TOO_LARGE, value=radius_m, limit=config.max_distance_m, limited_by="max_distance_m"
        )
    omega = abs(math.radians(angular_speed_deg_s))
    if omega * radius_m > config.max_speed_m_s * ROUNDING:
        return condition(
            ConditionCode.SPEED_ABOVE_LIMIT,
            value=angular_speed_deg_s,
            radius_m=radius_m,
            limit=math.degrees(config.max_speed_m_s / radius_m),
            max_speed_m_s=config.max_speed_m_s,
        )
    if omega**2 * radius_m > config.max_acceleration_m_s2 * ROUNDING:
        return condition(
            ConditionCode.ACCELERATION_ABOVE_LIMIT,
            value=angular_speed_deg_s,
            radius_m=radius_m,
            limit=math.degrees(math.sqrt(config.max_acceleration_m_s2 / radius_m)),
            max_acceleration_m_s2=config.max_acceleration_m_s2,
        )
    return None


FENCE_ROOM_M = 1.0  # of an orbit from the fence: its braking distance at 1.6 m/s


@dataclass(frozen=True)
class MavlinkBridgeConfig(SubjectConfig, OrbitConfig, SafetyConfig):
    """The link to the autopilot, its telemetry, the orbit, and the conditions for motion."""

    url: str = param(
        "udpin:127.0.0.1:14540",
        "udpin:HOST:PORT (listen), udpout:HOST:PORT, udp:HOST:PORT (as udpin), tcp:HOST:PORT, serial:DEVICE[:BAUD]",
    )
    system_id: int = param(
        1,
        "own MAVLink system, that of the carrying vehicle.  Never 255: it is the ground station's, and an "
        "autopilot that receives it does not notice the loss of the real one",
        minimum=1,
        maximum=254,
    )
    component_id: int = param(191, "own MAVLink component; 191 = onboard computer", minimum=2, maximum=250)
    target_system_id: int = param(0, "vehicle to read; 0 = the first autopilot", minimum=0, maximum=254)
    signing_key_file: str = param(
        "", "file with the 64 hexadecimal digits of the key by which packets are signed, both ways; empty = unsigned"
    )
    heartbeat_hz: float = param(1.0, "rate of our heartbeat", "Hz", 0.2, 10)
    attitude_hz: float = param(50.0, "wanted rate of attitude", "Hz", 1, 200)
    position_hz: float = param(30.0, "wanted rate of local position", "Hz", 1, 100)
    gimbal_hz: float = param(20.0, "wanted rate of the gimbal's attitude; 0 = not requested", "Hz", 0, 100)
    status_hz: float = param(5.0, "wanted rate of GPS, battery, estimator and landed state", "Hz", 0.2, 20)
    time_sync_hz: float = param(
        10.0, "rate of time synchronization; its answers show that the link works in both directions", "Hz", 0.1, 20
    )
    rate_window_s: float = param(3.0, "time over which the real rates are measured", "s", 1, 30)
    rate_shortfall: float = param(
        0.5, "share of the wanted rate below which a message is requested again", minimum=0, maximum=1
    )
    request_retry_s: float = param(2.0, "time between requests for the same message", "s", 0.2, 60)
    link_timeout_s: float = param(3.0, "silence after which the link counts as lost", "s", 0.5, 60)
    control_hz: float = param(20.0, "rate of setpoints", "Hz", 5, 50)
    watchdog_s: float = param(
        0.2, "time without a step of the control loop after which the watchdog holds the vehicle", "s", 0.1, 2
    )
    max_control_timeout_s: float = param(
        0.5, "longest time-out without setpoints: a longer or unknown one forbids motion; 0 = not checked", "s", 0, 10
    )
    gimbal_control: bool = param(False, "whether the mount's pitch follows the subject")

    @property
    def max_mode_age_s(self) -> float:
        """Greatest age of the report of the mode at which another one is requested: it is seen in the next step."""
        return 1.5 / self.control_hz

    def __post_init__(self) -> None:
        super().__post_init__()
        if (refusal := height_condition(self, self.height_m)) is not None:
            raise ParameterError(str(refusal))
        if self.radius_m + FENCE_ROOM_M > self.fence_radius_m:
            raise ParameterError(
                f"fence_radius_m: expected at least radius_m and 1 m, {self.radius_m + FENCE_ROOM_M:g}, "
                f"got {self.fence_radius_m:g}; widen the fence or come closer"
            )
        # One period of the loop is no hang: with less, every step would count as one.
        if self.watchdog_s < (periods_s := 2.0 / self.control_hz):
            raise ParameterError(
                f"watchdog_s: expected at least two periods of control_hz, {periods_s:.2g} s, got {self.watchdog_s:g}; "
                "raise it or control_hz"
            )
        # The age of the last answer grows by a period before the next one: with less it would hold the vehicle.
        if self.commands_enabled and self.time_sync_hz < (least_hz := 2.0 / self.max_round_trip_s):
            raise ParameterError(
                f"time_sync_hz: expected at least two answers within max_round_trip_s, {least_hz:.3g} Hz, to fly, "
                f"got {self.time_sync_hz:g}; raise one of the two"
            )
        for name, least in (("attitude_hz", 5.0), ("position_hz", 5.0), ("status_hz", 2.0)):
            if self.commands_enabled and getattr(self, name) < least:
                raise ParameterError(
                    f"{name}: expected at least {least:g} Hz to fly by it, got {getattr(self, name):g}; raise it or "
                    "set commands_enabled to false"
                )


WORTH_TELLING = 0.05  # share by which the flown radius or speed differs from the goal where the status says so


class OrbitGoal(NamedTuple):
    """Radius, height and angular speed that the operator wants."""

    radius_m: float
    height_m: float
    angular_speed_rad_s: float


def goal_of(
    config: OrbitConfig,
    radius_m: float = math.nan,
    height_m: float = math.nan,
    angular_speed_deg_s: float = math.nan,
    present: OrbitGoal | None = None,
) -> OrbitGoal:
    """Goal of a command, not validated; NaN = as at present, or as configured."""
    base = present or OrbitGoal(config.radius_m, config.height_m, math.radians(config.angular_speed_deg_s))
    radius = base.radius_m if math.isnan(radius_m) else radius_m
    height = base.height_m if math.isnan(height_m) else height_m
    speed = math.degrees(base.angular_speed_rad_s) if math.isnan(angular_speed_deg_s) else angular_speed_deg_s
    return OrbitGoal(radius, height, math.radians(speed))
