"""A plan of the flight: the place on the orbit whose view lowers the joints' expected deviation over the next seconds.

The forecast of the views comes from the adjustment (:mod:`drocap_ros.reconstruction.live.view_forecast`).  A plan is a
wish alone: radius, greatest speed and all checks are those of any orbit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from drocap_ros.flight.bridge_config import MavlinkBridgeConfig
from drocap_ros.flight.orbit.planner import OrbitState, Scene, advance, begin_orbit, reference_position
from drocap_ros.flight.orbit_config import OrbitConfig
from drocap_ros.flight.orbit_goal import OrbitGoal, Wish
from drocap_ros.flight.safety_config import HEIGHT_ROOM_M

EARLY_S = 5.0  # one way and the other at first: a ramp, and 50 degrees at 17 deg/s, in which errors of yaw show
LASTS_S = 6.0  # of a wish: adjustments come every second or two, and a person may do something else by then
_HORIZON_S = 15.0  # the far side of the orbit takes ten
_STEP_S = 0.5
_APART_DEG = 15.0  # between places that are compared
_TURN_LASTS_S = 2.0  # of a person: then he faces elsewhere, and goes on
_GAIN = 0.1  # share of the deviation by which another place must be better
_MIDDLE_M = 0.95  # height of a person's joints above his ground
_SWEEP_DEG = 30.0  # to both sides of the wished bearing, and the way of a turn: a still camera does not show sizes
_SWUNG_DEG = 50.0  # what is flown of it


class ViewForecast(NamedTuple):
    """Expected RMS errors (V,) m of joints in the views of a grid of bearings and elevations (V,) deg of the camera.

    turn_deg_s : how the person turns, counter-clockwise from above
    """

    bearing_deg: np.ndarray
    elevation_deg: np.ndarray
    error_m: np.ndarray
    turn_deg_s: float

    def _log_error(self, bearing_deg: np.ndarray, elevation_deg: np.ndarray) -> np.ndarray:
        """Linear between the views of the grid."""
        rows, columns = np.unique(self.elevation_deg), np.unique(self.bearing_deg)
        order = np.lexsort((self.bearing_deg, self.elevation_deg))
        table = np.log(self.error_m[order]).reshape(len(rows), len(columns))
        row = np.interp(elevation_deg, rows, np.arange(len(rows)))
        column = np.mod(bearing_deg - columns[0], 360.0) * len(columns) / 360.0
        low, left = np.floor(row).astype(int), np.floor(column).astype(int) % len(columns)
        high, right = np.minimum(low + 1, len(rows) - 1), (left + 1) % len(columns)
        up, on = row - low, column % 1.0
        below = (1.0 - on) * table[low, left] + on * table[low, right]
        above = (1.0 - on) * table[high, left] + on * table[high, right]
        found: np.ndarray = (1.0 - up) * below + up * above
        return found

    def expected_m(self, bearing_deg: np.ndarray, height_m: np.ndarray, radius_m: float) -> np.ndarray:
        """Expected error (m) at places of an orbit, their heights above the person's ground."""
        elevation_deg = np.degrees(np.arctan2(np.asarray(height_m) - _MIDDLE_M, radius_m))
        found: np.ndarray = np.exp(self._log_error(bearing_deg, elevation_deg))
        return found


class Reach(NamedTuple):
    """What an orbit reaches: its radius, greatest angular and vertical speed, least and greatest height."""

    radius_m: float
    fastest_deg_s: float
    climb_m_s: float
    heights_m: tuple[float, float]


def reach_of(config: MavlinkBridgeConfig, goal: OrbitGoal, radius_m: float, greatest_m_s: float) -> Reach:
    """What an orbit reaches that is flown at a radius, at ``greatest_m_s`` at most, for a goal."""
    fastest = min(abs(goal.angular_speed_rad_s), greatest_m_s / radius_m)
    heights = (config.min_height_m + HEIGHT_ROOM_M[0], config.max_height_m - HEIGHT_ROOM_M[1])
    return Reach(radius_m, math.degrees(fastest), config.approach_speed_m_s, heights)


def choose_view(
    views: ViewForecast, place: tuple[float, float], reach: Reach, former: Wish | None, now_s: float
) -> Wish:
    """The wish whose way has the least mean logarithm of the error: the log-determinant, for errors of one shape.

    Parameters
    ----------
    place : bearing rad and height m of the vehicle
    former : stays, unless another place is better by ``_GAIN``
    """
    bearings = np.arange(0.0, 360.0, _APART_DEG)
    heights = _MIDDLE_M + reach.radius_m * np.tan(np.radians(np.unique(views.elevation_deg)))
    targets: np.ndarray = np.stack(np.meshgrid(bearings, np.clip(heights, *reach.heights_m)), axis=-1).reshape(-1, 2)
    if former is not None:
        targets = np.vstack([(math.degrees(former.bearing_rad), former.height_m), targets])
    costs = way_costs(views, targets, place, reach)
    best = int(costs.argmin())
    if former is not None and costs[best] > costs[0] - _GAIN:
        best = 0
    ends = np.array([targets[best], [math.degrees(place[0]), place[1]]])
    there_mm, here_mm = 1e3 * views.expected_m(ends[:, 0], ends[:, 1], reach.radius_m)
    why = f"joints within {there_mm:.0f} mm are expected from there, {here_mm:.0f} mm from here"
    return Wish(math.radians(targets[best, 0]), float(targets[best, 1]), now_s + LASTS_S, why)


def way_costs(views: ViewForecast, targets: np.ndarray, place: tuple[float, float], reach: Reach) -> np.ndarray:
    """(N,) mean logarithms of the error over the horizon, on the shorter ways to targets (N, 2) deg, m, then there."""
    time = np.arange(0.0, _HORIZON_S, _STEP_S)
    left = np.mod(targets[:, :1] - math.degrees(place[0]) + 180.0, 360.0) - 180.0
    up = targets[:, 1:] - place[1]
    bearing = math.degrees(place[0]) + np.sign(left) * np.minimum(reach.fastest_deg_s * time, np.abs(left))
    beyond = np.maximum(reach.fastest_deg_s * time - np.abs(left), 0.0)
    bearing += 2.0 / np.pi * _SWUNG_DEG * np.arcsin(np.sin(0.5 * np.pi * beyond / _SWUNG_DEG))
    height = place[1] + np.sign(up) * np.minimum(reach.climb_m_s * time, np.abs(up))
    turned = views.turn_deg_s * np.minimum(time, _TURN_LASTS_S) if math.isfinite(views.turn_deg_s) else 0.0
    costs: np.ndarray = np.log(views.expected_m(bearing - turned, height, reach.radius_m)).mean(axis=1)
    return costs


def planned_goal(goal: OrbitGoal, wish: Wish, orbit: OrbitState) -> OrbitGoal:
    """What is flown for a wish: early one way and the other, then to its bearing and to and fro about it.

    The angular speed is that of the goal, forwards or backwards.
    """
    fastest = goal.angular_speed_rad_s
    if orbit.flown_s < 2 * EARLY_S:
        return goal._replace(angular_speed_rad_s=fastest if orbit.flown_s < EARLY_S else -fastest)
    left = math.remainder(wish.bearing_rad - orbit.phase, 2 * math.pi)
    sense = left if abs(left) > math.radians(_SWEEP_DEG) else orbit.omega.value
    return OrbitGoal(goal.radius_m, wish.height_m, math.copysign(fastest, sense))


def fly_plan(
    config: OrbitConfig,
    goal: OrbitGoal,
    subject: np.ndarray,
    step_s: float,
    greatest_speed_m_s: float,
    wish: Callable[[int, OrbitState], Wish | None],
    begin: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Path of a vehicle without errors: positions (F, 3) m and bearings (F,) rad, for a subject at (F, 3) m.

    wish : of the frame and the state of the orbit; None = the goal is flown
    begin : (3,) m, where the vehicle is at first
    """
    state = begin_orbit(begin, subject[0], config)
    places, bearings = [], []
    velocity = np.gradient(subject, step_s, axis=0)
    for frame, (place, moving) in enumerate(zip(subject, velocity, strict=True)):
        wished = wish(frame, state)
        flown = goal if wished is None else planned_goal(goal, wished, state)
        scene = Scene(reference_position(state), place, moving, greatest_speed_m_s=greatest_speed_m_s)
        state = advance(state, flown, scene, step_s, config)
        places.append(reference_position(state))
        bearings.append(state.phase)
    return np.array(places), np.array(bearings)
