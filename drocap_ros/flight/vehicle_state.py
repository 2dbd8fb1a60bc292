"""State of the vehicle at one instant: SI units, ENU world, FLU body, unknown = NaN."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

LANDED_UNDEFINED, LANDED_ON_GROUND, LANDED_IN_AIR, LANDED_TAKEOFF, LANDED_LANDING = range(5)
SATELLITES_UNKNOWN = 255  # by GPS_RAW_INT


def _unknown(size: int) -> np.ndarray:
    return np.full(size, np.nan)


@dataclass(frozen=True, eq=False)
class VehicleState:
    """State of the vehicle as its autopilot reports it; the fields of ``msg/VehicleState.msg``.

    stamp_ns : our clock's time of the attitude
    autopilot : name of an :class:`Autopilot`, or "other"
    mode : flight mode by the autopilot's own name
    landed_state : MAV_LANDED_STATE
    position_enu_m, velocity_enu_m_s : (3,) at ``stamp_ns``; origin = that of the autopilot's local frame
    orientation_xyzw : (4,) rotation body FLU -> ENU
    angular_velocity_flu_rad_s : (3,) body
    latitude_deg, longitude_deg, altitude_amsl_m : WGS 84, as last reported
    gps_fix_type : MAVLink GPS_FIX_TYPE, 3 = 3D
    satellites : in use, 255 = unknown
    position_ok : the estimator reports a usable attitude, velocity and position
    battery_fraction : [0, 1]
    gimbal_orientation_xyzw : (4,) rotation camera FLU -> ENU, on a gimbal, on servos or fixed to the body
    link_age_s : since the last message of the autopilot
    """

    stamp_ns: int
    autopilot: str = "other"
    mode: str = ""
    armed: bool = False
    landed_state: int = LANDED_UNDEFINED
    position_enu_m: np.ndarray = field(default_factory=lambda: _unknown(3))
    velocity_enu_m_s: np.ndarray = field(default_factory=lambda: _unknown(3))
    orientation_xyzw: np.ndarray = field(default_factory=lambda: _unknown(4))
    angular_velocity_flu_rad_s: np.ndarray = field(default_factory=lambda: _unknown(3))
    latitude_deg: float = float("nan")
    longitude_deg: float = float("nan")
    altitude_amsl_m: float = float("nan")
    gps_fix_type: int = 0
    satellites: int = SATELLITES_UNKNOWN
    position_ok: bool = False
    battery_fraction: float = float("nan")
    battery_voltage_v: float = float("nan")
    gimbal_orientation_xyzw: np.ndarray = field(default_factory=lambda: _unknown(4))
    link_age_s: float = float("nan")
