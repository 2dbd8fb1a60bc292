"""State of the vehicle at one instant: SI units, ENU world, FLU body, unknown = NaN."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, quaternion_multiply

_ENU_OF_NED, _SIGNS = np.array([1, 0, 2]), np.array([1.0, 1.0, -1.0])
_HALF = np.sqrt(0.5)
#: Rotation NED -> ENU (and ENU -> NED), x y z w: half a turn about north-east.
_NED_ENU = np.array([_HALF, _HALF, 0.0, 0.0])
#: Rotation FRD -> FLU (and FLU -> FRD): half a turn about forward.
_FRD_FLU = np.array([1.0, 0.0, 0.0, 0.0])
#: Camera body (x forward, y left, z up) -> optical frame (x right, y down, z forward).
OPTICAL_FROM_FLU = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def ned_to_enu(vector: np.ndarray) -> np.ndarray:
    """(..., 3) NED -> ENU, or back."""
    enu: np.ndarray = vector[..., _ENU_OF_NED] * _SIGNS
    return enu


enu_to_ned = ned_to_enu


def frd_to_flu(vector: np.ndarray) -> np.ndarray:
    """(..., 3) body FRD -> FLU, or back."""
    flu: np.ndarray = vector * np.array([1.0, -1.0, -1.0])
    return flu


flu_to_frd = frd_to_flu


def _as_matrix(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(4, 4) m with ``q @ m`` = ``before`` q ``after``: one product of a few numbers instead of two of quaternions."""
    return quaternion_multiply(quaternion_multiply(before, np.eye(4)), after)


_BETWEEN_AVIATION_AND_ROS = _as_matrix(_NED_ENU, _FRD_FLU)
_FLU_TO_OPTICAL = _as_matrix(np.array([0.0, 0.0, 0.0, 1.0]), quaternion_from_matrix(OPTICAL_FROM_FLU.T))


def orientation_to_ros(frd_to_ned: np.ndarray) -> np.ndarray:
    """(..., 4) x y z w, rotation body FRD -> NED, to the rotation body FLU -> ENU, or back; w of the result >= 0."""
    q: np.ndarray = frd_to_ned @ _BETWEEN_AVIATION_AND_ROS
    if q.ndim == 1:
        return -q if q[3] < 0 else q
    return np.where(q[..., 3:] < 0, -q, q)


orientation_to_aviation = orientation_to_ros


def optical_orientation(camera_flu_to_enu: np.ndarray) -> np.ndarray:
    """(..., 4) x y z w, rotation camera body FLU -> ENU, to the rotation optical frame -> ENU."""
    orientation: np.ndarray = camera_flu_to_enu @ _FLU_TO_OPTICAL
    return orientation


def quaternion_from_euler(
    roll_rad: float | np.ndarray, pitch_rad: float | np.ndarray, yaw_rad: float | np.ndarray
) -> np.ndarray:
    """(4,), or (4, N), x y z w of MAVLink's angles: yaw about down, then pitch, then roll; rotation body FRD -> NED."""
    half = 0.5 * np.array([roll_rad, pitch_rad, yaw_rad])
    cosine, sine = np.cos(half), np.sin(half)
    (cr, cp, cy), (sr, sp, sy) = (cosine.tolist(), sine.tolist()) if half.ndim == 1 else (cosine, sine)
    return np.array(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def yaw_of(frd_to_ned: np.ndarray) -> np.ndarray:
    """(...) rad, heading from north towards east, of rotations (..., 4) x y z w body FRD -> NED."""
    x, y, z, w = frd_to_ned.tolist() if frd_to_ned.ndim == 1 else np.moveaxis(frd_to_ned, -1, 0)
    yaw: np.ndarray = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaw


def camera_rotation(camera_flu_to_enu: np.ndarray) -> np.ndarray:
    """(..., 3, 3) world ENU -> optical frame, from the rotation (..., 4) x y z w camera FLU -> ENU."""
    rotation: np.ndarray = OPTICAL_FROM_FLU @ np.swapaxes(matrix_from_quaternion(camera_flu_to_enu), -1, -2)
    return rotation


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
