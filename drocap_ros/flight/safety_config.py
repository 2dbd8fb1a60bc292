"""Parameters of the conditions for motion."""

from __future__ import annotations

from dataclasses import dataclass

from drocap_ros.errors import ParameterError
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.parameters import Parameters, param

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
    resume_after_hold_s: float = param(
        0.0, "from the beginning of a hold by old data, in which the orbit may resume by itself; 0 = never", "s", 0, 30
    )
    engage_timeout_s: float = param(
        5.0, "time for the autopilot to enter GUIDED or OFFBOARD after `engage`", "s", 1, 30
    )

    def __post_init__(self) -> None:
        super().__post_init__()
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
