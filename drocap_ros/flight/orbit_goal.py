"""The orbit that the operator wants."""

from __future__ import annotations

import math
from typing import NamedTuple

from drocap_ros.flight.orbit_config import OrbitConfig

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
