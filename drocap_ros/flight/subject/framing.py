"""Whether the person stays in the picture of a camera that is fixed to the body, or on a mount that nothing points.

A copter leans to accelerate: towards the centre of its orbit, and against the wind.  A gimbal takes that away; a fixed
camera leans with the body, and the person moves in the picture by the same angle.  The lean needed against wind is
learned while the vehicle hovers.  On an orbit the nose turns through all directions, so it counts in each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drocap_ros.errors import InputError
from drocap_ros.flight.bridge_config import MavlinkBridgeConfig, OrbitGoal
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.subject.subject_filter import STANDING_M_S
from drocap_ros.flight.vehicle import VehicleState
from drocap_ros.geometry.rotations import matrix_from_quaternion

_GRAVITY = 9.81  # m/s^2
_HALF_WIDTH_M = 0.3  # of a person with the arms
_HEADROOM_M = 0.1  # above the head


class View(NamedTuple):
    """A camera that does not follow the person: matrix (3, 3) px, width and height px, pitch in rad, negative = down.

    level : whether a mount keeps the pitch against the horizon; else it is against the body
    """

    matrix: np.ndarray
    size: tuple[int, int]
    pitch: float
    level: bool = False


def framing_margin(
    view: View, distance_m: float, height_m: float, body_height_m: float, ahead: np.ndarray, left: np.ndarray
) -> np.ndarray:
    """(N,) distance of the person from the nearest border, as a share of the picture's height; negative = outside.

    distance_m : horizontal, along the nose
    height_m : of the camera above the person's ground
    ahead, left : (N,) rad, lean of the body: nose down, left side down
    """
    up = np.array([-height_m, body_height_m + _HEADROOM_M - height_m])
    corners = np.array([[distance_m, y, z] for y in (-_HALF_WIDTH_M, _HALF_WIDTH_M) for z in up])
    mount = _nose_down(np.array([-view.pitch]))
    forward, leftward, upward = np.moveaxis(_nose_down(ahead) @ _left_down(left) @ mount, -1, 0)
    depth = np.maximum(forward @ corners.T, 1e-6)
    u = view.matrix[0, 2] - view.matrix[0, 0] * (leftward @ corners.T) / depth
    v = view.matrix[1, 2] - view.matrix[1, 1] * (upward @ corners.T) / depth
    width, height = view.size
    inside = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v))
    margin: np.ndarray = np.where(depth > 0.1, inside, -height).min(axis=-1) / height
    return margin


def _nose_down(angle: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation about left, of angles (N,)."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([np.stack([c, zero, s], -1), np.stack([zero, zero + 1, zero], -1), np.stack([-s, zero, c], -1)], -2)


def _left_down(angle: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation against forward, of angles (N,)."""
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    return np.stack([np.stack([zero + 1, zero, zero], -1), np.stack([zero, c, s], -1), np.stack([zero, -s, c], -1)], -2)


def orbit_margin(view: View, goal: OrbitGoal, body_height_m: float, wind: float) -> float:
    """Least margin on an orbit, from its start on, whose lean against the wind is an acceleration of ``wind`` m/s^2.

    Gusts, and what it takes to keep to the orbit, lean the body further.
    """
    if view.level:
        none = np.zeros(1)
        return float(framing_margin(view, goal.radius_m, goal.height_m, body_height_m, none, none)[0])
    # Gusts are 1.2 times the mean wind; corrections take 0.4 m/s^2.
    lean = 1.2 * wind + 0.4
    # Directions of the nose against the wind, by 30 deg.
    around = np.linspace(0.0, 2 * math.pi, 12, endpoint=False)
    inward = np.array([[0.0], [goal.angular_speed_rad_s**2 * goal.radius_m]])
    ahead = np.arctan2(inward + lean * np.cos(around), _GRAVITY).ravel()
    left = np.arctan2(np.tile(lean * np.sin(around), 2), _GRAVITY)
    return float(framing_margin(view, goal.radius_m, goal.height_m, body_height_m, ahead, left).min())


def nearest_framed(view: View, height_m: float, body_height_m: float) -> float:
    """Least horizontal distance (m) at which the whole person is in the picture of a level body; inf = at none."""
    focal, middle = view.matrix[1, 1], view.matrix[1, 2]
    below = math.atan((view.size[1] - middle) / focal) - view.pitch
    above = math.atan(middle / focal) + view.pitch
    sides = ((height_m, below), (body_height_m + _HEADROOM_M - height_m, above))
    if any(reach > 0.0 >= angle for reach, angle in sides):
        return math.inf
    return max(reach / math.tan(angle) for reach, angle in sides if reach > 0.0)


class Framing:
    """Watches the picture of a camera that does not follow the person; with another one it refuses nothing.

    matrix : (3, 3) px; None before the first calibration.  :meth:`calibrate` sets it
    size : width and height of the pictures, px; None before the first
    follows : whether the mount's pitch follows the person
    """

    def __init__(self, config: MavlinkBridgeConfig) -> None:
        self._config = config
        self.matrix: np.ndarray | None = None
        self.size: tuple[int, int] | None = None
        self.follows = config.gimbal_control
        self._mount_pitch = math.nan  # rad, against the horizon
        self._judged_by: np.ndarray | None = None  # matrix of the distances so far
        self._wind = np.zeros(2)  # m/s^2 ENU, by which the vehicle leans without accelerating
        self._still_s = 0.0
        self._learned_s = 0.0

    def calibrate(self, matrix: np.ndarray) -> Condition | None:
        """Take a camera matrix (3, 3) px; returns a condition where it is that of another camera or zoom."""
        if not np.isfinite(matrix).all() or np.any(np.diag(matrix)[:2] <= 0):
            raise InputError("camera_info: expected a camera matrix with positive focal lengths; calibrate the camera")
        self.matrix, before = np.asarray(matrix, dtype=float), self._judged_by
        # Against the first one, so that slow changes add up.
        # A camera matrix may change by 3 % of the focal length.
        if before is not None and np.abs(self.matrix - before).max() <= 0.03 * before[0, 0]:
            return None
        self._judged_by = self.matrix
        if before is None:
            return None
        return condition(ConditionCode.CAMERA_CHANGED, before_px=before[0, 0], now_px=self.matrix[0, 0])

    def watch(self, vehicle: VehicleState, velocity: np.ndarray, dt: float) -> None:
        """Learn the lean against wind, ``dt`` s after the last one; velocity (3,) m/s."""
        self._mount_pitch = _pitch(vehicle.gimbal_orientation_xyzw)
        view = self.view()
        if view is None or view.level or not np.isfinite(vehicle.orientation_xyzw).all():
            return
        up = matrix_from_quaternion(vehicle.orientation_xyzw)[:, 2]
        # The body's axis leans further where the vehicle tumbles.
        if up[2] < 0.3:
            return
        step_s = min(max(dt, 0.0), 0.2)
        # Only a hover leans by the wind alone.
        self._still_s = self._still_s + step_s if float(np.hypot(*velocity[:2])) < 0.5 else 0.0
        # The lean of the braking before has gone after a second.
        if self._still_s > 1.0:
            # The lean against wind is learned over 4 s: a gust passes, the wind stays.
            self._learned_s = min(self._learned_s + step_s, 4.0)
            share = step_s / max(self._learned_s, 1e-3)
            self._wind = self._wind + share * (_GRAVITY * up[:2] / up[2] - self._wind)

    def refusal(self, goal: OrbitGoal) -> Condition | None:
        """Why an orbit loses the person; None = it does not, or nothing is known."""
        view, config = self.view(), self._config
        if view is None:
            return None
        margin = orbit_margin(view, goal, config.body_height_m, float(np.hypot(*self._wind)))
        # A mount may cut off a fifth of the picture of feet or head: it does not lean further.
        if margin >= (-0.2 if view.level else 0.0):
            return None
        return condition(
            ConditionCode.PERSON_LEAVES_PICTURE,
            missing_percent=-100 * margin,
            radius_m=goal.radius_m,
            height_m=goal.height_m,
            speed_deg_s=math.degrees(abs(goal.angular_speed_rad_s)),
            camera=f"a mount that stays at {math.degrees(view.pitch):.0f} deg"
            if view.level
            else "the fixed camera, as the body leans,",
            remedy="point the mount at the person, or set gimbal_control to true"
            if view.level
            else "tilt the camera to the person, fly slower or farther away, or use a wider lens or a gimbal",
        )

    def least_radius(self, goal: OrbitGoal, subject_speed_m_s: float, gives_way_s: float) -> float:
        """Radius (m) at which one who walks up to the vehicle stays in a fixed camera's picture; 0 = any, or he stands.

        At most ``max_distance_m``.

        subject_speed_m_s : horizontal
        gives_way_s : of the autopilot
        """
        view, walking = self.view(), subject_speed_m_s - STANDING_M_S
        if view is None or view.level or walking <= 0.0:
            return 0.0
        comes_m = gives_way_s * walking
        radius = nearest_framed(view, goal.height_m, self._config.body_height_m) + comes_m
        return min(radius, self._config.max_distance_m)

    def view(self) -> View | None:
        """The camera that does not follow the person; None = it follows, or nothing is known of it."""
        if self.matrix is None or self.size is None:
            return None
        if self._config.mount == "fixed":
            return View(self.matrix, self.size, math.radians(self._config.camera_pitch_deg))
        if self.follows or math.isnan(self._mount_pitch):
            return None
        return View(self.matrix, self.size, self._mount_pitch, level=True)


def _pitch(camera_xyzw: np.ndarray) -> float:
    """Pitch in rad of a camera (4,) FLU -> ENU against the horizon, negative = down; NaN = unknown."""
    if not np.isfinite(camera_xyzw).all():
        return math.nan
    return math.asin(min(max(float(matrix_from_quaternion(camera_xyzw)[2, 0]), -1.0), 1.0))
