"""The vehicle: frames, its state, the filter of what is reported of it, and where its camera was.

Position and velocity are weighed by how they err.

The two reports contradict each other, and which one is the better differs: on one of the recorded autopilots the
velocity errs by 0.25 m/s for seconds, on the other by 0.02 m/s (``lab/studies/report_errors.py``).  The error of the
velocity is therefore a state of a Kalman filter, and its size is estimated in flight, within bounds.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drocap_ros.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix, quaternion_multiply, slerp
from drocap_ros.stamps import NS

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


class CameraPose(NamedTuple):
    """(3, 3) world ENU -> optical, (3,) m ENU, and rad by which the heading has turned beyond the gyroscope's rates."""

    rotation: np.ndarray
    position: np.ndarray
    turned: float = 0.0


class PoseHistory:
    """States of the last seconds, by their stamps.

    keep_s : how far back
    """

    def __init__(self, keep_s: float = 3.0) -> None:
        self._keep_ns = int(keep_s * NS)
        self._poses: deque[tuple[int, np.ndarray, np.ndarray, float]] = deque()
        self._turning = (0, math.nan, math.nan)  # stamp, heading, its rate by the gyroscope
        self._turned = 0.0
        #: (3,) m, reported minus filtered position now: add it to a position from here.
        self.offset: np.ndarray = np.zeros(3)

    def add(self, state: VehicleState, place: np.ndarray) -> None:
        """Take a state; without position or camera's attitude it is left out.  A stamp that goes back clears all.

        place : (3,) m, its filtered position
        """
        camera = state.gimbal_orientation_xyzw
        self._turn(state)
        if not (np.isfinite(camera).all() and np.isfinite(state.position_enu_m).all()):
            return
        if self._poses and state.stamp_ns <= self._poses[-1][0]:
            self._poses.clear()
        self.offset = state.position_enu_m - place
        self._poses.append((state.stamp_ns, camera, place, self._turned))
        while state.stamp_ns - self._poses[0][0] > self._keep_ns:
            self._poses.popleft()

    def _turn(self, state: VehicleState) -> None:
        """Add what the heading has turned beyond the gyroscope's rates; after a gap, or without rates, nothing."""
        nose, rates = matrix_from_quaternion(state.orientation_xyzw), state.angular_velocity_flu_rad_s
        before_ns, before, rate_before = self._turning
        heading, rate = math.atan2(nose[1, 0], nose[0, 0]), float(nose[2] @ rates) if np.any(rates) else math.nan
        gap_s, self._turning = (state.stamp_ns - before_ns) / NS, (state.stamp_ns, heading, rate)
        turned = math.remainder(heading - before, 2 * math.pi) - 0.5 * gap_s * (rate_before + rate)
        if 0.0 < gap_s <= _LONGEST_GAP_S and math.isfinite(turned):
            self._turned += turned

    def reached(self, stamp_ns: int) -> bool:
        """Whether a state of this instant or a later one is known."""
        return bool(self._poses) and stamp_ns <= self._poses[-1][0]

    def at(self, stamp_ns: int) -> CameraPose | None:
        """Pose at an instant; None outside the states."""
        if not self.reached(stamp_ns) or stamp_ns < self._poses[0][0]:
            return None
        later = self._poses[-1]
        for pose in reversed(self._poses):
            if pose[0] <= stamp_ns:
                part = (stamp_ns - pose[0]) / max(later[0] - pose[0], 1)
                position = (1 - part) * pose[2] + part * later[2]
                turned = (1 - part) * pose[3] + part * later[3]
                return CameraPose(camera_rotation(slerp(pose[1], later[1], part)), position, turned)
            later = pose
        return None


#: s, in which the error of a reported velocity fades: recorded ones halve within 2 s.
_FADES_S = 2.5
#: m^2/s: a reported position wanders by itself as a random walk, at least so: recorded of both autopilots.
_LEAST_WANDER_M2_S = 4e-4
_WANDERED_S = 2.0  # whose wander of the position counts as its noise
_LONGEST_GAP_S = 0.5  # that the velocity bridges
_JUMP_M = 0.5  # from one reported position to the next, beyond what the velocity explains; recorded: 0.1 m at most


class Doubt(NamedTuple):
    """What a report contradicts: a step of the position in m, a lasting error of the velocity in m/s; 0 = nothing."""

    jump_m: float = 0.0
    error_m_s: float = 0.0

    def worse(self, other: Doubt) -> Doubt:
        """The greater of each."""
        return Doubt(max(self.jump_m, other.jump_m), max(self.error_m_s, other.error_m_s))


class VehicleFilter:
    """Reports of one flight, in the order of their stamps.

    velocity_sd_m_s : of the reported velocity, until the flight has shown it

    Attributes
    ----------
    position, velocity : (3,) m, m/s, ENU; NaN before the first report
    """

    def __init__(self, velocity_sd_m_s: float) -> None:
        self._variance: np.ndarray = np.full(3, velocity_sd_m_s**2)
        self._stamp_s = math.nan
        self._reported: tuple[np.ndarray, np.ndarray] = (np.full(3, np.nan), np.full(3, np.nan))
        self.position: np.ndarray = np.full(3, np.nan)
        self.velocity: np.ndarray = np.full(3, np.nan)
        self._error: np.ndarray = np.zeros(3)  # of the reported velocity
        self._covariance: np.ndarray = np.zeros((3, 2, 2))  # of position and error
        self._wander: np.ndarray = np.full(3, _LEAST_WANDER_M2_S)
        self._block: tuple[float, np.ndarray] = (0.0, np.zeros(3))  # s, and m that the velocity does not explain
        self._before: np.ndarray | None = None  # (3,) m/s, mean of the block before

    @property
    def velocity_offset(self) -> np.ndarray:
        """(3,) m/s, reported minus filtered velocity."""
        return self._error

    def take(self, stamp_s: float, position: np.ndarray, velocity: np.ndarray) -> Doubt:
        """Take a report, (3,) m and (3,) m/s ENU, and say what it contradicts.

        After a gap, a step back in time or a jump of the position the filter begins anew at the report.  Stamps may
        jump with the position, as where the autopilot restarts: the way since then is bounded by the longest gap.
        """
        gap_s, jump_m = stamp_s - self._stamp_s, 0.0
        if math.isfinite(gap_s):
            way = min(max(gap_s, 0.0), _LONGEST_GAP_S) * 0.5 * (self._reported[1] + velocity)
            step = position - self._reported[0] - way
            jump_m = math.sqrt(step @ step)
        if 0.0 < gap_s <= _LONGEST_GAP_S and jump_m <= _JUMP_M:
            self._predict(gap_s, 0.5 * (self._reported[1] + velocity))
            self._correct(gap_s, position)
            self._learn(gap_s, step)
        else:
            self._begin(position)
        self._stamp_s, self._reported = stamp_s, (position, velocity)
        self.velocity = velocity - self._error
        error_m_s = math.sqrt(self._error @ self._error)
        return Doubt(
            jump_m if jump_m > _JUMP_M else 0.0,
            error_m_s if error_m_s > 1.5 else 0.0,  # no healthy autopilot's; recorded: 0.9 m/s at most
        )

    def _begin(self, position: np.ndarray) -> None:
        self._block, self._before = (0.0, np.zeros(3)), None
        self.position = position.copy()
        self._covariance = np.zeros((3, 2, 2))
        self._covariance[:, 0, 0], self._covariance[:, 1, 1] = self._wander * _WANDERED_S, self._variance

    def _predict(self, gap_s: float, velocity: np.ndarray) -> None:
        """Move on by a mean reported velocity; its error fades and is renewed."""
        fade = math.exp(-gap_s / _FADES_S)
        self.position = self.position + gap_s * (velocity - self._error)
        self._error = fade * self._error
        step = np.array([[1.0, -gap_s], [0.0, fade]])
        self._covariance = step @ self._covariance @ step.T
        self._covariance[:, 1, 1] += (1.0 - fade**2) * self._variance

    def _correct(self, gap_s: float, position: np.ndarray) -> None:
        """Move towards a reported position."""
        # Reports that follow each other sooner hold less news each.
        noise = self._wander * _WANDERED_S**2 / gap_s
        gain = self._covariance[:, :, 0] / (self._covariance[:, 0, 0] + noise)[:, None]
        innovation = position - self.position
        self.position = self.position + gain[:, 0] * innovation
        self._error = self._error + gain[:, 1] * innovation
        self._covariance = self._covariance - gain[:, :, None] * self._covariance[:, None, 0, :]

    def _learn(self, gap_s: float, step: np.ndarray) -> None:
        """Sizes of the velocity's error and of the position's wander, from a step (3,) m that neither explains."""
        wander = step**2 / gap_s - self._variance * gap_s
        self._wander = np.maximum(
            self._wander + (wander - self._wander) * (1.0 - math.exp(-gap_s / 5.0)),
            _LEAST_WANDER_M2_S,
        )
        # The mean error of a block is compared with the next one's: a position that wanders by itself errs otherwise
        # from block to block; the error of a velocity lasts.
        seconds, way = self._block[0] + gap_s, self._block[1] + step
        self._block = (seconds, way)
        if seconds < 0.5:
            return
        mean, before = way / seconds, self._before
        self._block, self._before = (0.0, np.zeros(3)), mean
        if before is not None:
            found = mean * before * math.exp(seconds / _FADES_S)
            variance = self._variance + (found - self._variance) * (1.0 - math.exp(-seconds / 20.0))
            # Half the best recorded standard deviation, twice the worst.
            self._variance = np.clip(variance, 0.01**2, 0.6**2)
