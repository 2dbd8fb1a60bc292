"""Messages that may leave the port: the allow-list, and the setpoints and commands that pass it.

It contains no command to arm or to take off, and no mode but the control and hold modes of the autopilots.
"""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drocap_ros.flight.autopilot import AUTOPILOTS
from drocap_ros.flight.autopilot.setpoint import Setpoint
from drocap_ros.flight.frames import enu_to_ned
from drocap_ros.flight.mavlink.message import Message

SET_MODE = mavlink.MAV_CMD_DO_SET_MODE
GIMBAL_PITCH = mavlink.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW
TELEMETRY_COMMANDS = frozenset({mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE})
TELEMETRY = frozenset({"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "PARAM_REQUEST_READ"})
_MODES = frozenset(a.mode_parameters(mode)[1:3] for a in AUTOPILOTS.values() for mode in (a.control_mode, a.hold_mode))
#: What SET_POSITION_TARGET_LOCAL_NED leaves out where it is velocity and yaw rate alone.
_VELOCITY_ONLY = sum(
    getattr(mavlink, f"POSITION_TARGET_TYPEMASK_{name}_IGNORE") for name in ("X", "Y", "Z", "AX", "AY", "AZ", "YAW")
)


def is_telemetry(message: Message) -> bool:
    """Whether the message only requests or answers telemetry: always allowed."""
    name = message.get_type()
    return name in TELEMETRY and (name != "COMMAND_LONG" or message.command in TELEMETRY_COMMANDS)


def is_motion(message: Message) -> bool:
    """Whether it is a setpoint, a mode on the list or the mount's pitch: allowed with ``commands_enabled``."""
    if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
        return True
    if message.get_type() != "COMMAND_LONG":
        return False
    if message.command == SET_MODE:
        return (float(message.param2), float(message.param3)) in _MODES
    return bool(message.command == GIMBAL_PITCH)


def setpoint_message(mav: mavlink.MAVLink, target: tuple[int, int], setpoint: Setpoint) -> Message:
    """Position, velocity, acceleration, yaw and yaw rate in one message.

    Raises
    ------
    ValueError
        When a value is not finite: such a setpoint has crashed an autopilot.
    """
    if not setpoint.is_finite():
        raise ValueError("expected a setpoint of finite values")
    return _encode(mav, target, 0, setpoint)


def halt_message(mav: mavlink.MAVLink, target: tuple[int, int]) -> Message:
    """Velocity and yaw rate zero: the setpoint for a vehicle whose position is unknown."""
    return _encode(mav, target, _VELOCITY_ONLY, Setpoint(np.zeros(3), np.zeros(3), np.zeros(3), math.pi / 2, 0.0))


def command_message(
    mav: mavlink.MAVLink, target: tuple[int, int], command: int, confirmation: int, parameters: tuple[float, ...]
) -> Message:
    """COMMAND_LONG of a command."""
    message: Message = mav.command_long_encode(*target, command, confirmation, *parameters)
    return message


def _encode(mav: mavlink.MAVLink, target: tuple[int, int], mask: int, setpoint: Setpoint) -> Message:
    # ENU to NED: yaw from east counter-clockwise becomes yaw from north clockwise.
    heading = math.remainder(math.pi / 2 - setpoint.yaw, 2 * math.pi)
    vectors = (float(v) for vector in setpoint[:3] for v in enu_to_ned(vector))
    message: Message = mav.set_position_target_local_ned_encode(
        0, *target, mavlink.MAV_FRAME_LOCAL_NED, mask, *vectors, heading, -setpoint.yaw_rate
    )
    return message
