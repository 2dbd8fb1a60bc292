"""Flight paths of the simulated vehicle as functions of time."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from drocap_ros.flight.frames import OPTICAL_FROM_FLU
from drocap_ros.geometry.rotations import quaternion_from_matrix, slerp
from drocap_ros.simulation.orbit_camera import orbit_camera


class VehiclePose(NamedTuple):
    """Vehicle at one instant: (3,) m and m/s ENU, (4,) x y z w body FLU -> ENU, (3,) rad/s FLU, camera FLU -> ENU."""

    position_enu_m: np.ndarray
    velocity_enu_m_s: np.ndarray
    orientation_xyzw: np.ndarray
    angular_velocity_flu_rad_s: np.ndarray
    gimbal_orientation_xyzw: np.ndarray


class FlightPath(Protocol):
    """A path that the simulated vehicle follows without error."""

    def at(self, t_s: float) -> VehiclePose:
        """Pose at an instant; at rest before the start and after the end."""


class SampledPath:
    """Path through sampled camera poses: the camera is at the vehicle's position, the nose follows its bearing.

    Parameters
    ----------
    t_s : (F,) increasing
    rotation : (F, 3, 3) world ENU -> camera optical
    position : (F, 3) m ENU
    """

    def __init__(self, t_s: np.ndarray, rotation: np.ndarray, position: np.ndarray) -> None:
        self._t = np.asarray(t_s, dtype=float)
        self._position = position
        self._velocity = np.gradient(position, self._t, axis=0) if len(self._t) > 1 else np.zeros_like(position)
        self._camera = quaternion_from_matrix(np.swapaxes(rotation, 1, 2) @ OPTICAL_FROM_FLU)
        forward = rotation[:, 2]
        self._yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))

    def at(self, t_s: float) -> VehiclePose:
        """Pose at an instant."""
        t = self._t
        inside = float(np.clip(t_s, t[0], t[-1]))
        i = int(np.clip(np.searchsorted(t, inside, side="right") - 1, 0, max(len(t) - 2, 0)))
        j = min(i + 1, len(t) - 1)
        part = (inside - t[i]) / (t[j] - t[i]) if j > i else 0.0
        moving = 1.0 if t[0] <= t_s <= t[-1] else 0.0
        yaw = (1 - part) * self._yaw[i] + part * self._yaw[j]
        yaw_rate = (self._yaw[j] - self._yaw[i]) / (t[j] - t[i]) if j > i else 0.0
        return VehiclePose(
            (1 - part) * self._position[i] + part * self._position[j],
            moving * ((1 - part) * self._velocity[i] + part * self._velocity[j]),
            np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]),
            np.array([0.0, 0.0, moving * yaw_rate]),
            slerp(self._camera[i], self._camera[j], part),
        )


def orbit_path(seconds: float, radius_m: float = 6.0, height_m: float = 2.5, speed_deg_s: float = 25.0) -> SampledPath:
    """Orbit about a point 0.9 m above the origin."""
    t = np.arange(0.0, seconds + 0.02, 0.02)
    centre = np.broadcast_to(np.array([0.0, 0.0, 0.9]), (len(t), 3))
    rotation, position = orbit_camera(t, centre, radius_m, height_m, speed_deg_s)
    return SampledPath(t, rotation, position)
