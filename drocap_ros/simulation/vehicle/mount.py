"""The camera's mount of a simulated copter: where the camera truly points, and what the autopilot reports of it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from drocap_ros.flight.vehicle import orientation_to_aviation, orientation_to_ros, quaternion_from_euler, yaw_of
from drocap_ros.geometry.rotations import quaternion_multiply

#: By the value of ArduPilot's MNT1_TYPE.
MOUNT_TYPES = {"fixed": 0, "servo": 1, "gimbal": 6}
_LIMITS_DEG = (-90.0, 30.0)


class SimulatedMount:
    """One of three mounts.  Pitch is MAVLink's: negative = down.

    kind : "gimbal" = keeps its pitch against the horizon and reports it; "servo" = one servo tilts the camera by the
        wanted pitch less the body's, without a sensor: the demanded angle against the body is reported, the camera
        rolls with the body; "fixed" = the camera has this pitch against the body, and nothing is reported
    pitch : rad, wanted

    Source: ArduPilot's AP_Mount_Servo, and its simulation (a servo mount reports demanded angles in the body's frame).
    """

    def __init__(self, kind: str = "gimbal", pitch_deg: float = -14.0) -> None:
        self.kind, self.pitch = kind, math.radians(pitch_deg)
        self._tilt: float | None = None  # rad, of the servo

    def command(self, pitch_deg: float) -> bool:
        """Take a wanted pitch against the horizon; returns whether there is a mount to take it."""
        if self.kind != "fixed" and math.isfinite(pitch_deg):
            self.pitch = math.radians(min(max(pitch_deg, _LIMITS_DEG[0]), _LIMITS_DEG[1]))
        return self.kind != "fixed"

    def step(self, body_xyzw: Callable[[], np.ndarray], dt: float) -> None:
        """Let the servo turn for ``dt`` s; ``body_xyzw`` (4,) FLU -> ENU, asked for by a servo alone."""
        if self.kind != "servo":
            return
        demanded = self._demanded(body_xyzw())
        before = demanded if self._tilt is None else self._tilt
        # A hobby servo turns 60 deg in 0.1 to 0.2 s; its lag of 0.06 s is assumed.
        self._tilt = before + (demanded - before) * (1 - math.exp(-dt / 0.06))

    def camera(self, body_xyzw: np.ndarray) -> np.ndarray:
        """(4,) camera FLU -> ENU, truth, on a body (4,) FLU -> ENU."""
        if self.kind == "gimbal":
            return level_camera(body_xyzw, self.pitch)
        tilt = self.pitch if self.kind == "fixed" or self._tilt is None else self._tilt
        return tilted_camera(body_xyzw, tilt)

    def report(
        self, body_xyzw: np.ndarray, gimbal_error_rad: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[np.ndarray, int] | None:
        """What the autopilot reports of its mount, with the errors of a gimbal's pitch and yaw; None without a mount.

        That is the content of GIMBAL_DEVICE_ATTITUDE_STATUS: (4,) w x y z, and flags.

        body_xyzw : (4,) FLU -> ENU as the autopilot estimates it
        """
        from pymavlink.dialects.v20 import ardupilotmega as mavlink

        if self.kind == "fixed":
            return None
        pitch, yaw = self._demanded(body_xyzw), 0.0
        if self.kind == "gimbal":
            pitch, yaw = self.pitch + gimbal_error_rad[0], gimbal_error_rad[1]
        x, y, z, w = quaternion_from_euler(0.0, pitch, yaw)
        # ArduPilot sets the first two for every mount, servos included.
        locked = mavlink.GIMBAL_DEVICE_FLAGS_ROLL_LOCK | mavlink.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
        return np.array([w, x, y, z]), int(locked | mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME)

    def _demanded(self, body_xyzw: np.ndarray) -> float:
        """rad, angle of the servo: what is wanted, less the body's pitch."""
        x, y, z, w = orientation_to_aviation(body_xyzw)
        lean = math.asin(min(1.0, max(-1.0, 2 * (w * y - z * x))))
        return min(max(self.pitch - lean, math.radians(_LIMITS_DEG[0])), math.radians(_LIMITS_DEG[1]))


def level_camera(body_xyzw: np.ndarray, pitch: float) -> np.ndarray:
    """(4,) camera FLU -> ENU, level in the heading of a body (4,) FLU -> ENU, at a pitch in rad."""
    heading = float(yaw_of(orientation_to_aviation(body_xyzw)))
    return orientation_to_ros(quaternion_from_euler(0.0, pitch, heading))


def tilted_camera(body_xyzw: np.ndarray, pitch: float) -> np.ndarray:
    """(4,) camera FLU -> ENU, at a pitch in rad against a body (4,) FLU -> ENU."""
    body = orientation_to_aviation(body_xyzw)
    return orientation_to_ros(quaternion_multiply(body, quaternion_from_euler(0.0, pitch, 0.0)))
