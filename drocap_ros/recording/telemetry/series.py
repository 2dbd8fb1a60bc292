"""Series of a log in our axes and at common times."""

from __future__ import annotations

import numpy as np

from drocap_ros.flight.vehicle_state import orientation_to_ros, quaternion_from_euler
from drocap_ros.geometry.geodesy import geodetic_to_enu
from drocap_ros.geometry.interpolation import interpolate

#: Longest gap of one series of a log over which it is interpolated: ten periods of the slowest usual rate, 10 Hz.
_SERIES_GAP_S = 1.0


def dji_attitude(pitch_roll_yaw_deg: np.ndarray) -> np.ndarray:
    """(N, 4) x y z w FLU -> ENU of DJI's angles (N, 3): pitch positive up, yaw clockwise from north."""
    pitch, roll, yaw = np.deg2rad(pitch_roll_yaw_deg).T
    return orientation_to_ros(quaternion_from_euler(roll, pitch, yaw).T)


def from_first_fix(geodetic: np.ndarray, *, above_takeoff: bool = False) -> np.ndarray | None:
    """(N, 3) m ENU of latitude deg, longitude deg and height m from the first state that has all; None without one.

    Heights above take-off stay as they are.
    """
    fixed = np.isfinite(geodetic).all(axis=1)
    if not fixed.any():
        return None
    origin = geodetic[fixed][0].copy()
    if above_takeoff:
        origin[2] = 0.0
    return geodetic_to_enu(geodetic, origin)


def at_stamps(known_ns: np.ndarray, values: np.ndarray, stamp_ns: np.ndarray, *, spherical: bool) -> np.ndarray:
    """One series of a log (N, C) at the times (F,) of another, NaN across gaps of more than a second."""
    order = np.argsort(known_ns, kind="stable")
    known_ns, values = known_ns[order], np.asarray(values, np.float64)[order]
    fresh = np.concatenate([[True], np.diff(known_ns) > 0])
    found, _ = interpolate(known_ns[fresh], values[fresh], stamp_ns, spherical=spherical, max_gap_s=_SERIES_GAP_S)
    return found
