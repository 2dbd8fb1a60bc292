"""Parameters of the orbit and the limits of every setpoint."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drocap_ros.errors import ParameterError
from drocap_ros.flight.conditions import ROUNDING, Condition, ConditionCode, condition
from drocap_ros.parameters import Parameters, param

_ROOM_M = 0.5  # of an orbit from min_distance_m: the error of the flown radius
LEAST_REVERSAL_S = 10.0  # a turn takes two ramps


@dataclass(frozen=True)
class OrbitConfig(Parameters):
    """The orbit that is flown unless a command changes it, and the limits of every orbit.

    Raises
    ------
    ParameterError
        Also when the values contradict each other: an orbit inside the minimum distance, or one that needs more
        speed or acceleration than allowed.
    """

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
    least = config.min_distance_m + _ROOM_M
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
