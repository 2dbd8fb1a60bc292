"""A camera that circles a person and looks at it."""

from __future__ import annotations

import numpy as np

from drocap_ros.geometry.alignment import directions


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(F, 3, 3) world (ENU) -> camera (x right, y down, z forward), level, from position towards target (F, 3) m.

    A camera straight above or below its target has no level; its right is then world x.
    """
    forward = directions(target - position)
    right = np.stack([forward[:, 1], -forward[:, 0], np.zeros(len(forward))], axis=1)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    right = np.where(length > 1e-6, right / np.maximum(length, 1e-6), np.array([1.0, 0.0, 0.0]))
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def orbit_camera(
    t: np.ndarray,
    centre: np.ndarray,
    radius_m: float,
    height_m: float,
    speed_deg_s: float,
    start_deg: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of a camera that circles a moving centre and points at it.

    t : (F,) s
    centre : (F, 3) m ENU
    radius_m, height_m : horizontal distance from the centre; height above the ground (z = 0)
    speed_deg_s : positive = counter-clockwise from above
    start_deg : bearing of the camera from the centre at t = 0, 0 = east

    Returns
    -------
    rotation (F, 3, 3) world -> camera optical, position (F, 3) m ENU.
    """
    angle = np.deg2rad(start_deg + speed_deg_s * np.asarray(t))
    position = np.stack(
        [
            centre[:, 0] + radius_m * np.cos(angle),
            centre[:, 1] + radius_m * np.sin(angle),
            np.full(len(centre), float(height_m)),
        ],
        axis=1,
    )
    return look_at(position, centre), position
