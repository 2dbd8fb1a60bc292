"""Parameters of the orbit and what the vehicle may be asked."""

from __future__ import annotations

import math
from dataclasses import dataclass

from drocap_ros.errors import ParameterError
from drocap_ros.parameters import Parameters, param


@dataclass(frozen=True)
class OrbitConfig(Parameters):
    """The orbit that is flown when nothing else is commanded, and the limits of every orbit.

    Raises
    ------
    ParameterError
        Also when the values contradict each other: an orbit inside the minimum distance, or one that needs more
        speed or acceleration than allowed.
    """

    radius_m: float = param(6.0, "horizontal distance from the subject", unit="m", minimum=0, maximum=100)
    height_m: float = param(2.5, "height above the subject's ground", unit="m", minimum=0, maximum=100)
    angular_speed_deg_s: float = param(
        19.0, "angular speed, positive = counter-clockwise seen from above", unit="deg/s", minimum=-60, maximum=60
    )
    min_distance_m: float = param(3.0, "least horizontal distance from the subject", unit="m", minimum=1.0, maximum=100)
    max_distance_m: float = param(
        20.0, "greatest horizontal distance from the subject at which an orbit may begin", unit="m", minimum=2,
        maximum=200,
    )  # fmt: skip
    max_speed_m_s: float = param(4.5, "greatest speed asked of the vehicle", unit="m/s", minimum=0.2, maximum=15)
    max_acceleration_m_s2: float = param(
        2.0, "greatest acceleration asked of the vehicle; an orbit needs omega^2 radius", unit="m/s^2", minimum=0.1,
        maximum=5,
    )  # fmt: skip
    max_jerk_m_s3: float = param(2.0, "greatest change of acceleration", unit="m/s^3", minimum=0.1, maximum=20)
    ramp_s: float = param(3.0, "time to reach the angular speed", unit="s", minimum=0.5, maximum=30)
    approach_speed_m_s: float = param(1.0, "speed of changes of radius and height", unit="m/s", minimum=0.05, maximum=5)
    max_subject_speed_m_s: float = param(
        2.5, "greatest speed at which the orbit's centre follows the subject", unit="m/s", minimum=0, maximum=10
    )
    max_lead_m: float = param(
        1.5, "greatest distance of the position setpoint from the vehicle", unit="m", minimum=0.2, maximum=10
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_orbit(self, self.radius_m, self.angular_speed_deg_s)


def check_orbit(config: OrbitConfig, radius_m: float, angular_speed_deg_s: float) -> None:
    """Refuse an orbit that its limits do not allow.

    Raises
    ------
    ParameterError
    """
    if radius_m < config.min_distance_m + 0.5:
        raise ParameterError(
            f"radius_m: expected at least {config.min_distance_m + 0.5:g} m (min_distance_m and 0.5 m of room), "
            f"got {radius_m:g}; choose a larger radius"
        )
    if radius_m > config.max_distance_m:
        raise ParameterError(
            f"radius_m: expected at most {config.max_distance_m:g} m (max_distance_m), got {radius_m:g}; "
            "choose a smaller radius"
        )
    omega = abs(math.radians(angular_speed_deg_s))
    if omega * radius_m > config.max_speed_m_s:
        fastest = math.degrees(config.max_speed_m_s / radius_m)
        raise ParameterError(
            f"angular_speed_deg_s: expected at most {fastest:.1f} deg/s at {radius_m:g} m (max_speed_m_s "
            f"{config.max_speed_m_s:g}), got {angular_speed_deg_s:g}; fly slower or closer"
        )
    if omega**2 * radius_m > config.max_acceleration_m_s2:
        fastest = math.degrees(math.sqrt(config.max_acceleration_m_s2 / radius_m))
        raise ParameterError(
            f"angular_speed_deg_s: expected at most {fastest:.1f} deg/s at {radius_m:g} m (max_acceleration_m_s2 "
            f"{config.max_acceleration_m_s2:g}), got {angular_speed_deg_s:g}; fly slower or closer"
        )
