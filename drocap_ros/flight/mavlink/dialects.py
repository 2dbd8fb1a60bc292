"""Dialects of ArduPilot Copter and PX4: modes and setpoints as MAVLink messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.frames import enu_to_ned
from drocap_ros.flight.setpoint import Setpoint

#: Type masks of SET_POSITION_TARGET_LOCAL_NED: all fields, and velocity with yaw rate alone.
_ALL = 0
_VELOCITY_ONLY = 1 | 2 | 4 | 64 | 128 | 256 | 1024


@dataclass(frozen=True)
class Dialect:
    """One autopilot's modes.

    control_mode, hold_mode : names as in :class:`VehicleState`, with the two numbers of DO_SET_MODE
    warm_up_s : how long setpoints must be sent before the control mode is granted
    """

    name: str
    control_mode: str
    control_numbers: tuple[int, int]
    hold_mode: str
    hold_numbers: tuple[int, int]
    warm_up_s: float

    def mode_parameters(self, hold: bool) -> tuple[float, ...]:
        """The seven parameters of MAV_CMD_DO_SET_MODE."""
        main, sub = self.hold_numbers if hold else self.control_numbers
        return (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(main), float(sub), 0.0, 0.0, 0.0, 0.0)


#: BRAKE, because LOITER flies on unless a stick is centred.  The vehicle is at rest when it is requested.
ARDUPILOT = Dialect("ardupilot", "GUIDED", (4, 0), "BRAKE", (17, 0), 0.0)
#: OFFBOARD needs setpoints above 2 Hz for more than 1 s before; hold = AUTO.LOITER.
PX4 = Dialect("px4", "OFFBOARD", (6, 0), "LOITER", (4, 3), 1.2)
DIALECTS = {dialect.name: dialect for dialect in (ARDUPILOT, PX4)}


def setpoint_message(mav: Any, target: tuple[int, int], setpoint: Setpoint) -> Any:
    """Position, velocity, acceleration, yaw and yaw rate in one message.

    Raises
    ------
    ValueError
        When a value is not finite: such a setpoint has crashed an autopilot.
    """
    if not setpoint.is_finite():
        raise ValueError("expected a setpoint of finite values")
    return _encode(
        mav, target, _ALL, setpoint.position, setpoint.velocity, setpoint.acceleration, setpoint.yaw,
        setpoint.yaw_rate,
    )  # fmt: skip


def halt_message(mav: Any, target: tuple[int, int]) -> Any:
    """Velocity and yaw rate zero: the setpoint for a vehicle whose position is unknown."""
    zero = np.zeros(3)
    return _encode(mav, target, _VELOCITY_ONLY, zero, zero, zero, math.pi / 2, 0.0)


def _encode(
    mav: Any, target: tuple[int, int], mask: int, position: np.ndarray, velocity: np.ndarray,
    acceleration: np.ndarray, yaw: float, yaw_rate: float
) -> Any:  # fmt: skip
    # ENU to NED: yaw from east counter-clockwise becomes yaw from north clockwise.
    heading = math.remainder(math.pi / 2 - yaw, 2 * math.pi)
    vectors = (float(v) for vector in (position, velocity, acceleration) for v in enu_to_ned(vector))
    return mav.set_position_target_local_ned_encode(
        0, *target, mavlink.MAV_FRAME_LOCAL_NED, mask, *vectors, heading, -yaw_rate
    )
