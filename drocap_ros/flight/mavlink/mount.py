"""Where the camera points: from the messages of its mount, or from the body to which it is fixed.

Angles of a mount follow MAVLink: pitch is positive up, so a camera that looks down has a negative one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import Autopilot
from drocap_ros.flight.conditions import Condition, ConditionCode, condition
from drocap_ros.flight.mavlink.commands import Message
from drocap_ros.flight.vehicle_state import orientation_to_ros, quaternion_from_euler, yaw_of
from drocap_ros.geometry.rotations import LENGTH_ERROR, normalized, quaternion_multiply, slerp
from drocap_ros.stamps import NS

_EARTH, _NOSE = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME, mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
_STALE_S = {"gimbal": 3.0, "servo": 0.5}  # without angles; those of servos follow the body's lean
_STEP_S = 0.25  # between two reports, beyond which a rotation is not extrapolated
#: A servo follows its demanded angle this much later: a frame of its signal, and its turning.
_SERVO_DELAY_S = 0.05


class Mount:
    """The camera's attitude at each attitude of the body.

    kind : one of ``subject_config.MOUNT_KINDS``
    pitch_deg : of a fixed camera against the body, negative = down
    """

    def __init__(self, kind: str = "auto", pitch_deg: float = 0.0) -> None:
        self._kind = kind
        self._fixed = quaternion_from_euler(0.0, math.radians(pitch_deg), 0.0)
        #: Whether it is servos by the autopilot's parameter; None = not reported.  Servos report their commands,
        #: against the body, under the flags of angles against the horizon.
        self.servos: bool | None = None
        self._latest: _Angles | None = None
        self._before: _Angles | None = None
        self._knows = True  # whether its last message had angles

    @property
    def kind(self) -> str:
        """One of "gimbal", "servo" and "fixed"; "" = no mount has reported its angles."""
        if self._kind != "auto":
            return self._kind
        if self.servos:
            return "servo"
        return "" if self._latest is None else "gimbal"

    @property
    def _stale_s(self) -> float:
        """Greatest age of the angles in s: less where the mount still reports, and not its angles (NaN)."""
        return min(_STALE_S.get(self.kind, math.inf), math.inf if self._knows else _STALE_S["servo"])

    def take(self, message: Message, now_ns: int) -> None:
        """Take a message of the mount."""
        angles = _READERS[message.get_type()](message)
        self._knows = angles is not None
        if angles is not None:
            self._before, self._latest = self._latest, _Angles(now_ns, *angles)

    def age_s(self, now_ns: int) -> float:
        """Time in s since the mount's last message, infinity before the first; 0 for a fixed camera."""
        if self.kind == "fixed":
            return 0.0
        return math.inf if self._latest is None else (now_ns - self._latest.received_ns) / NS

    def problem(self, autopilot: Autopilot, now_ns: int) -> Condition | None:
        """Why the camera's attitude must not be relied on; None = it may be."""
        if self.kind == "":
            return condition(ConditionCode.CAMERA_UNKNOWN)
        if self._kind == "auto" and autopilot.mount_type_setting and self.servos is None:
            return condition(ConditionCode.MOUNT_TYPE_UNKNOWN, name=autopilot.mount_type_setting)
        if self.age_s(now_ns) > self._stale_s:
            return condition(ConditionCode.MOUNT_OUTDATED, age_s=self.age_s(now_ns))
        return None

    def camera_at(self, body: np.ndarray, received_ns: int) -> np.ndarray:
        """(4,) x y z w camera FLU -> ENU at an attitude of the body FRD -> NED and its reception; NaN = unknown.

        Messages of the mount come at other times than the attitude.  Its last rotation is extrapolated over at most
        one period: at 25 deg/s and 20 Hz the error would be a degree.  A servo lags its command; without
        this lag a body that rocks at 40 deg/s would be 2 degrees off.
        """
        if self.kind == "fixed":
            return orientation_to_ros(quaternion_multiply(body, self._fixed))
        if self._latest is None or self.age_s(received_ns) > self._stale_s:
            return np.full(4, np.nan)
        latest, before = self._latest, self._before
        angles = latest.quaternion
        if before is not None and before.from_north == latest.from_north:
            step_ns = latest.received_ns - before.received_ns
            if 0 < step_ns <= _STEP_S * NS:
                delay_s = _SERVO_DELAY_S if self.kind == "servo" else 0.0
                after_ns = received_ns - int(delay_s * NS) - latest.received_ns
                part = min(max(after_ns / step_ns, -1.0), 1.0)
                angles = slerp(before.quaternion, angles, 1.0 + part)
        if self.kind == "servo":
            return orientation_to_ros(quaternion_multiply(body, angles))
        if not latest.from_north:
            nose = quaternion_from_euler(0.0, 0.0, float(yaw_of(body)))
            angles = quaternion_multiply(nose, angles)
        return orientation_to_ros(angles)


class _Angles(NamedTuple):
    """(4,) x y z w of the mount's angles FRD, and whether their yaw is against north instead of the nose."""

    received_ns: int
    quaternion: np.ndarray
    from_north: bool


def _device_attitude(message: Message) -> tuple[np.ndarray, bool] | None:
    w, x, y, z = message.q
    quaternion = finite_quaternion(x, y, z, w)
    if quaternion is None:
        return None
    from_north = _EARTH if message.flags & (_EARTH | _NOSE) else mavlink.GIMBAL_DEVICE_FLAGS_YAW_LOCK
    return quaternion, bool(message.flags & from_north)


def _orientation(message: Message) -> tuple[np.ndarray, bool] | None:
    absolute = message.yaw_absolute
    # A v1 message has no absolute yaw and decodes it as 0: the yaw relative to the vehicle is used instead.
    from_north = math.isfinite(absolute) and absolute != 0.0
    angles = np.deg2rad([message.roll, message.pitch, absolute if from_north else message.yaw])
    return (quaternion_from_euler(*angles), from_north) if np.isfinite(angles).all() else None


def _status(message: Message) -> tuple[np.ndarray, bool]:
    pitch, roll, yaw = np.deg2rad(
        np.array([message.pointing_a, message.pointing_b, message.pointing_c], dtype=float) * 1e-2
    )
    return quaternion_from_euler(roll, pitch, yaw), False


#: Messages of a mount: (4,) x y z w of its angles, and whether the yaw is against north instead of the nose.
_READERS = {
    "GIMBAL_DEVICE_ATTITUDE_STATUS": _device_attitude,
    "MOUNT_ORIENTATION": _orientation,
    "MOUNT_STATUS": _status,
}
MESSAGES = frozenset(_READERS)


def finite_quaternion(x: float, y: float, z: float, w: float) -> np.ndarray | None:
    """Normalized (4,) x y z w; None where a value is not finite or the length is too far from 1."""
    off = abs(math.sqrt(x * x + y * y + z * z + w * w) - 1.0)  # NaN is below nothing
    return np.array(normalized(x, y, z, w)) if off < LENGTH_ERROR else None
