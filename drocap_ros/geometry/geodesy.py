"""Places on the Earth (WGS 84) and the local frame ENU at one of them."""

from __future__ import annotations

import numpy as np

_EQUATOR_RADIUS_M = 6_378_137.0  # m, WGS 84
_ECCENTRICITY2 = 6.694379990141316e-3  # WGS 84, first eccentricity squared


def _ecef(latitude_deg: np.ndarray, longitude_deg: np.ndarray, altitude_m: np.ndarray) -> np.ndarray:
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    normal = _EQUATOR_RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (normal + altitude_m) * np.cos(lat) * np.cos(lon),
            (normal + altitude_m) * np.cos(lat) * np.sin(lon),
            (normal * (1 - _ECCENTRICITY2) + altitude_m) * np.sin(lat),
        ],
        axis=-1,
    )


def _enu_axes(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """(3, 3) rotation ECEF -> ENU."""
    lat, lon = np.deg2rad(latitude_deg), np.deg2rad(longitude_deg)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


def geodetic_to_enu(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(..., 3) m ENU at ``origin``, of (..., 3) latitude deg, longitude deg, altitude m (WGS 84).

    ``origin`` is (3,) of the same kind.
    """
    offset = _ecef(*np.moveaxis(geodetic, -1, 0)) - _ecef(*origin)
    enu: np.ndarray = offset @ _enu_axes(origin[0], origin[1]).T
    return enu


def enu_to_geodetic(enu: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(..., 3) latitude deg, longitude deg, altitude m, of (..., 3) m ENU at ``origin`` (3,)."""
    x, y, z = np.moveaxis(enu @ _enu_axes(origin[0], origin[1]) + _ecef(*origin), -1, 0)
    across = np.hypot(x, y)
    lat = np.arctan2(z, across * (1 - _ECCENTRICITY2))
    for _ in range(5):  # converges by a factor of about 300 a step near the ground
        normal = _EQUATOR_RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + _ECCENTRICITY2 * normal * np.sin(lat), across)
    normal = _EQUATOR_RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    # This form of the altitude holds at the poles too, where across / cos(lat) does not.
    altitude = across * np.cos(lat) + z * np.sin(lat) - _EQUATOR_RADIUS_M**2 / normal
    return np.stack([np.rad2deg(lat), np.rad2deg(np.arctan2(y, x)), altitude], axis=-1)
